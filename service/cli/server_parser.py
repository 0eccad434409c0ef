"""The part of the command line that has to do with a server: `serve`, `admin`, and asking one from elsewhere."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from service.cli import import_parser

_SERVE = """\
Serve the REST API and the page, and run submitted jobs, until stopped.

--data has the database, uploads and results. On a loopback address requests need no key; on others each request needs
one (`lvba admin key create`). Every option can also be set in the environment: LVBA_DATA, LVBA_PORT, ..."""

_SERVE_EXAMPLES = """\
examples:
  lvba serve
  lvba serve --data /srv/lvba --host 0.0.0.0 --jobs 2 --root /recordings
  lvba serve --database postgresql://lvba@db/lvba --scheduler tls://head:8786 --tls-ca ca.pem ..."""

_ADMIN = """\
Manage keys and tables of a server, on its machine, with its --data and --database."""

_ADMIN_EXAMPLES = """\
examples:
  lvba admin key create survey-team --scopes read,submit
  lvba admin key list
  lvba admin key revoke 3f9a1c2b4d5e
  lvba admin migrate
  lvba admin sweep"""

_SUBMIT = """\
Send a recording to a server and start a job.

RECORDING is a folder, an archive or a bag to upload (an interrupted upload continues), the id of a dataset on the
server, or a URL in an object store that the server may read. A bag is looked at first: what is missing or wrong is told
before anything is sent. The id of the job goes to stdout."""

_SUBMIT_EXAMPLES = """\
examples:
  lvba submit recording --server http://127.0.0.1:8080
  lvba submit ds_3f... --set visual.levels=2 --wait
  lvba submit recording.tar.gz --name yard --priority 5
  lvba submit walk.bag --odometry auto --calibration camera.yaml
  lvba submit s3://recordings/yard

LVBA_SERVER and LVBA_KEY replace --server and --key-file."""

Add = Callable[..., Any]
"""`main._command`."""


def add(commands: Any, command: Add) -> None:
    """Add all commands of this file."""
    _add_serve(commands, command)
    _add_admin(commands, command)
    _add_submit(commands, command)
    _add_questions(commands, command)


def _add_serve(commands: Any, command: Add) -> None:
    serve = command(commands, "serve", "answer requests and run jobs", _SERVE, _SERVE_EXAMPLES)
    _add_place(serve)
    serve.add_argument("--host", metavar="ADDRESS", help="to listen on (default: 127.0.0.1)")
    serve.add_argument("--port", type=int, metavar="PORT", help="to listen on (default: 8080; 0: any)")
    serve.add_argument("--auth", action="store_true", default=None, help="require keys on loopback too")
    serve.add_argument(
        "--host-name",
        action="append",
        dest="hosts",
        metavar="NAME",
        help="host name accepted in requests; repeatable",
    )
    serve.add_argument(
        "--proxy",
        action="append",
        dest="proxies",
        metavar="NET",
        help="address or network of a reverse proxy whose X-Forwarded-For is trusted; repeatable",
    )
    serve.add_argument(
        "--root",
        action="append",
        dest="roots",
        metavar="PLACE",
        help="recordings in it may be registered; a folder, or s3://BUCKET/PATH; repeatable",
    )
    serve.add_argument("--jobs", type=int, metavar="N", help="jobs at a time (default: 1; 0: run none)")
    serve.add_argument("--workers", type=int, metavar="N", help="worker processes of a job")
    serve.add_argument("--memory-limit", metavar="GB", help="of each of the --workers, for example 8GB")
    serve.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler on which jobs run")
    for name in ("ca", "cert", "key"):
        serve.add_argument(f"--tls-{name}", type=Path, metavar="FILE", help="PEM, for the scheduler")
    serve.add_argument(
        "--keep-days", type=float, metavar="D", help="remove ended jobs after D days (default: never)"
    )
    serve.add_argument(
        "--webhooks", action="store_true", default=None, help="allow webhooks to addresses given by users"
    )
    serve.add_argument(
        "--webhook-allow",
        action="append",
        metavar="ORIGIN",
        help="allow webhooks to this address though it is not public; repeatable",
    )


def _add_place(parser: Any) -> None:
    parser.add_argument("--data", type=Path, metavar="DIR", help="data folder (default: lvba-data)")
    parser.add_argument("--database", metavar="URL", help="postgresql://... (default: SQLite in --data)")


def _add_admin(commands: Any, command: Add) -> None:
    admin = command(commands, "admin", "keys and tables of a server", _ADMIN, _ADMIN_EXAMPLES)
    actions = admin.add_subparsers(dest="action", metavar="ACTION", required=True)
    key = actions.add_parser("key", help="API keys").add_subparsers(
        dest="key_action", metavar="ACTION", required=True
    )
    create = key.add_parser("create", help="create a key; it is shown once")
    create.add_argument("owner", metavar="OWNER", help="owner; keys of one owner see the same jobs")
    create.add_argument("--scopes", default="read,submit", help="of read, submit, metrics, admin")
    create.add_argument("--days", type=float, metavar="D", help="the key expires after D days")
    create.add_argument("--note", default="", help="purpose of the key")
    revoke = key.add_parser("revoke", help="revoke a key")
    revoke.add_argument("key", metavar="ID", help="as listed by `lvba admin key list`")
    others = [
        key.add_parser("list", help="all keys, without their secrets"),
        actions.add_parser("migrate", help="migrate the tables to this version"),
        actions.add_parser("sweep", help="remove now what retention would remove"),
    ]
    for parser in (create, revoke, *others):
        _add_place(parser)
    others[2].add_argument("--keep-days", type=float, metavar="D", help="as of the server")


def _add_submit(commands: Any, command: Add) -> None:
    submit = command(commands, "submit", "send a recording to a server", _SUBMIT, _SUBMIT_EXAMPLES)
    submit.add_argument(
        "recording", metavar="RECORDING", help="folder, archive, bag, id of a dataset, or s3://BUCKET/PATH"
    )
    submit.add_argument("--name", metavar="NAME", help="of dataset and job (default: the folder's)")
    submit.add_argument("--config", type=Path, metavar="FILE", help="settings, YAML")
    submit.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="one setting; may be repeated"
    )
    submit.add_argument(
        "--priority", type=int, default=0, metavar="P", help="-10..10, higher first (default: 0)"
    )
    submit.add_argument("--reference", action="store_true", help="compare with reference/ in the recording")
    submit.add_argument(
        "--wait", action="store_true", help="wait until it has ended; exit code 1 if it failed"
    )
    choices = submit.add_argument_group("of a bag", "what `lvba import` takes; a server runs no commands")
    import_parser.add_choices(choices, _count)
    add_server(submit)


def _count(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} is not 1 or more")
    return number


def _add_questions(commands: Any, command: Add) -> None:
    jobs = command(
        commands, "jobs", "list the jobs on a server", "List your jobs on a server, newest first.", ""
    )
    jobs.add_argument("--state", metavar="STATE", help="queued, running, done, failed or canceled only")
    add_server(jobs)
    for name, summary in (
        ("status", "show the progress of a job"),
        ("logs", "show the log of a job"),
        ("cancel", "stop a job; finished stages stay on the server"),
        ("fetch", "get the results of a job"),
    ):
        parser = command(commands, name, summary, summary[0].upper() + summary[1:] + ".", "")
        parser.add_argument("job", metavar="JOB", help="its id, as lvba submit printed it")
        add_server(parser)
        if name == "status":
            parser.add_argument("--json", action="store_true", help="everything, as JSON")
        if name == "logs":
            parser.add_argument("--follow", action="store_true", help="until the job has ended")
        if name == "fetch":
            parser.add_argument("--out", type=Path, metavar="OUT", help="folder (default: the job's name)")
            parser.add_argument("names", nargs="*", metavar="NAME", help="only these, such as map.ply")


def add_server(parser: Any, *, asked: bool = True) -> None:
    """Add --server and --key-file; asked: a server is asked also where none is named."""
    default = "default: LVBA_SERVER, or http://127.0.0.1:8080" if asked else "run the jobs on this server"
    parser.add_argument("--server", metavar="URL", help=default)
    parser.add_argument("--key-file", type=Path, metavar="FILE", help="holds the API key (default: LVBA_KEY)")


def is_asked(name: str) -> bool:
    """Whether a command asks a server that runs elsewhere."""
    return name in ("submit", "jobs", "status", "logs", "cancel", "fetch")


def settings_given(arguments: argparse.Namespace) -> dict[str, Any]:
    """What of a server's settings the command line gives."""
    names = "data database host port auth hosts proxies roots jobs threads workers memory_limit scheduler"
    names += " tls_ca tls_cert tls_key keep_days webhooks webhook_allow"
    return {name: getattr(arguments, name, None) for name in names.split()}
