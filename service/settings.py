"""What a server is started with. The only place that reads the environment for it."""

import dataclasses
import ipaddress
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lvba import config
from lvba.errors import InputError
from service.system import store_urls

PREFIX = "LVBA_"
GB = 1 << 30


@dataclass(frozen=True)
class Limits:
    """What one owner, one request or one archive may take."""

    upload_bytes: int = 200 * GB
    """Largest single file or archive."""
    owner_bytes: int = 2000 * GB
    """All datasets and results of an owner, also unfinished and refused ones."""
    owner_files: int = 5_000_000
    """Files of all datasets of an owner."""
    archive_entries: int = 200_000
    """Files and folders in an archive."""
    archive_bytes: int = 500 * GB
    """All files of an archive, unpacked."""
    archive_ratio: float = 200.0
    """Unpacked to packed size of an archive."""
    queued_jobs: int = 200
    """Jobs of an owner that wait."""
    running_jobs: int = 8
    """Jobs of an owner that run."""
    requests_per_s: float = 200.0
    """Requests of a key, on average ..."""
    requests_burst: int = 1000
    """... and at once."""
    validation_s: float = 3600.0
    """Seconds that the check of a dataset may take."""
    validation_memory_bytes: int = 16 * GB
    """Address space that it may take."""
    attempts: int = 3
    """How often a job is tried whose process was killed."""
    disk_reserve_bytes: int = 2 * GB
    """What must stay free beside the estimate of a new job."""
    json_bytes: int = 64 << 10
    """Body of a request that is neither an upload nor a batch."""
    batch_bytes: int = 4 << 20
    """Body of a batch."""
    check_bytes: int = 16 << 20
    """Body of a check of names: a line for each file of a recording, with its poses and calibration."""
    inspection_bytes: int = 64 << 20
    """Pieces of a bag that are looked at before it is uploaded."""
    connections: int = 4000
    """Connections at a time; fewer where the system allows fewer open files."""
    connections_of_one: int = 2000
    """Of one address, proxies excepted; never all."""
    head_s: float = 15.0
    """Seconds until the head of a request is all there."""
    stall_s: float = 60.0
    """Seconds that a client may keep the server waiting in the midst of a body, or of an answer that it does not take."""
    slowest_bytes_per_s: float = 1024.0
    """What a body must bring on average, after its first `stall_s`."""


@dataclass(frozen=True)
class Settings:
    """Of one server. Every field can come from the environment as LVBA_<FIELD>, of `limits` as LVBA_LIMITS_<FIELD>.

    LVBA_<FIELD>_FILE names a file that holds the value, for what should not be in an environment.
    """

    data: Path = Path("lvba-data")
    """Folder of the database, the uploads and the results."""
    database: str = ""
    """URL of the database; empty: SQLite in `data`."""
    host: str = "127.0.0.1"
    """Address to listen on."""
    port: int = 8080
    """Port to listen on; 0: any that is free."""
    auth: bool = False
    """Ask for keys on a loopback address too; elsewhere they are always asked for."""
    hosts: tuple[str, ...] = ()
    """Names that requests may call this server by, beside loopback; empty: any, if keys are asked for."""
    proxies: tuple[str, ...] = ()
    """Addresses or networks of reverse proxies whose X-Forwarded-For header is trusted, also on loopback."""
    roots: tuple[str, ...] = ()
    """Folders below which recordings may be registered in place, and URLs of object stores (s3://BUCKET/PATH)."""
    jobs: int = 1
    """Jobs at a time; 0: this instance only answers, others work."""
    threads: int | None = None
    """Threads of a job; None: all cores."""
    workers: int | None = None
    """Worker processes of a job; None: it runs in one process."""
    memory_limit: str | None = None
    """Memory of each of the `workers`, such as 8GB; None: an even share."""
    scheduler: str | None = None
    """Dask scheduler on which jobs run."""
    tls_ca: Path | None = None
    """PEM, authority of the cluster."""
    tls_cert: Path | None = None
    """PEM, own certificate for the cluster."""
    tls_key: Path | None = None
    """PEM, its key."""
    keep_days: float = 0.0
    """Days that ended jobs are kept where they do not say otherwise; 0: for good."""
    keep_uploads_days: float = 7.0
    """Days that unfinished uploads are kept without a request; 0: for good."""
    webhooks: bool = False
    """Call the webhook URLs that users give, when a job ends."""
    webhook_allow: tuple[str, ...] = ()
    """Origins (http://host:port) that may be called although they are not public."""
    webhook_timeout_s: float = 10.0
    """Seconds that calling one URL may take in all."""
    lease_s: float = 20.0
    """A job whose service has not been heard of for so long is taken over."""
    limits: Limits = field(default_factory=Limits)

    @property
    def database_url(self) -> str:
        """As SQLAlchemy takes it."""
        if not self.database:
            return f"sqlite:///{self.data.absolute() / 'lvba.sqlite'}"
        url = self.database
        for plain in ("postgres://", "postgresql://"):
            if url.startswith(plain):
                return "postgresql+psycopg://" + url.removeprefix(plain)
        return url

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach the server."""
        return self.host in LOOPBACK

    @property
    def asks_for_keys(self) -> bool:
        """Whether requests need a key."""
        return self.auth or not self.loopback


LOOPBACK = ("127.0.0.1", "localhost", "::1")


def load(given: Mapping[str, Any], environment: Mapping[str, str] = os.environ) -> Settings:
    """The settings of the environment with those given (None: not given) over them.

    Raises InputError: a value that cannot be meant.
    """
    values = _from_environment(Settings, PREFIX, environment)
    values |= {name: value for name, value in given.items() if value is not None}
    limits = _build(Limits, values.pop("limits", {}))
    settings: Settings = dataclasses.replace(_build(Settings, values), limits=limits)
    roots = tuple(
        store_urls.checked_root(root) if store_urls.is_url(root) else root for root in settings.roots
    )
    settings = dataclasses.replace(settings, roots=roots)
    for proxy in settings.proxies:
        _check_network(proxy)
    return settings


def _check_network(text: str) -> None:
    try:
        ipaddress.ip_network(text)
    except ValueError as error:
        raise InputError(
            PREFIX + "PROXIES", str(error), "write addresses, or networks as 10.1.0.0/16"
        ) from None


def _from_environment(kind: Any, prefix: str, environment: Mapping[str, str]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for item in dataclasses.fields(kind):
        name = prefix + item.name.upper()
        if item.name == "limits":
            values["limits"] = _from_environment(Limits, name + "_", environment)
        elif name in environment:
            values[item.name] = environment[name]
        elif name + "_FILE" in environment:
            values[item.name] = _content(name + "_FILE", Path(environment[name + "_FILE"]))
    return values


def _content(name: str, file: Path) -> str:
    try:
        return file.read_text("utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            name, f"{file} cannot be read ({error})", "name a file that holds the value"
        ) from None


def _build(kind: Any, values: Mapping[str, Any]) -> Any:
    built = {}
    hints = {item.name: item.type for item in dataclasses.fields(kind)}
    for name, value in values.items():
        built[name] = _value(name, value, hints[name])
    return kind(**built)


def _value(name: str, value: Any, hint: Any) -> Any:
    if hint == tuple[str, ...]:
        items = value.split(",") if isinstance(value, str) else value
        return tuple(str(item) for item in items if item)
    if hint is Path or hint == (Path | None):
        return Path(value)
    if hint is bool and isinstance(value, str):
        return config.coerce(value.lower() in ("1", "true", "yes", "on"), bool, PREFIX + name.upper(), name)
    if hint == (int | None) or hint is int:
        return _whole(name, value)
    return config.coerce(value, hint, PREFIX + name.upper(), name)


def _whole(name: str, value: Any) -> int:
    try:
        number = int(value)
    except ValueError:
        raise InputError(PREFIX + name.upper(), f"{value!r} is not a whole number", "give one") from None
    if number < 0:
        raise InputError(PREFIX + name.upper(), f"{number} is negative", "give 0 or more")
    return number
