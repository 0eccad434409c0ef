"""`lvba admin`: keys, tables and retention of a server, on its machine."""

import argparse
import sys
from datetime import UTC, datetime

from service.cli.progress import Display
from service.cli.server_parser import settings_given
from service.datasets import leftovers
from service.db import keys
from service.db.data_folder import open_database
from service.db.database import Database
from service.db.tables import Key
from service.jobs.retention import Retention
from service.settings import Settings, load
from service.system.paths import Paths


def admin(arguments: argparse.Namespace, display: Display) -> None:
    """Do what the command line says; what comes of it goes to stdout."""
    settings = load(settings_given(arguments))
    paths = Paths(settings.data.resolve())
    database = open_database(settings, paths)
    try:
        _do(arguments, settings, database, paths)
    finally:
        database.close()


def _do(arguments: argparse.Namespace, settings: Settings, database: Database, paths: Paths) -> None:
    if arguments.action == "migrate":
        sys.stdout.write("the tables are as this version needs them\n")
    elif arguments.action == "sweep":
        removed = Retention(database, paths, settings).sweep(sure_s=0.0)
        leftovers.sweep(database, paths, uploads=True)
        sys.stdout.write(f"{removed} removed\n")
    elif arguments.key_action == "create":
        scopes = tuple(scope.strip() for scope in arguments.scopes.split(",") if scope.strip())
        key = keys.create(database, arguments.owner, scopes, arguments.note, arguments.days)
        sys.stdout.write(key + "\n")
    elif arguments.key_action == "revoke":
        keys.revoke(database, arguments.key)
    else:
        for row in keys.every(database):
            sys.stdout.write(_line(row) + "\n")


def _line(key: Key) -> str:
    state = "revoked" if key.revoked else f"expires {_date(key.expires)}" if key.expires else "good"
    scopes = ",".join(key.scopes)
    return f"{key.id}  {_date(key.created)}  {state:<19}  {scopes:<20}  {key.owner}  {key.note}".rstrip()


def _date(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).date().isoformat()
