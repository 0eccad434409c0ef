"""The data folder and the database, made ready for this version."""

from sqlalchemy.exc import SQLAlchemyError

from lvba.errors import InputError, LvbaError
from service.db.database import Database
from service.settings import Settings
from service.system.paths import Paths


def open_database(settings: Settings, paths: Paths) -> Database:
    """The database with its tables as this version needs them.

    Raises LvbaError: it cannot be reached or written.
    """
    try:
        paths.make()
    except OSError as error:
        raise InputError(
            settings.data, f"cannot be used ({error.strerror})", "give --data another folder"
        ) from None
    try:
        database = Database(settings.database_url)
    except ImportError as error:
        raise InputError(
            "--database", f"needs a package that is not here ({error})", "pip install 'lvba[postgres]'"
        ) from None
    try:
        database.migrate()
    except SQLAlchemyError as error:
        said = str(error).splitlines()[0]
        raise LvbaError(f"database: cannot be used ({said}); check --database") from None
    return database
