"""What a run says when somebody removes what its stages made while it needs it."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from lvba.errors import ArtifactError
from lvba.plan import MissingError


@contextmanager
def explained(out: Path, keys: Collection[str]) -> Iterator[None]:
    """Turn the failure to read an artifact or a file in OUT that was there before into one line that says so.

    keys: of all artifacts of the plan
    Raises: ArtifactError
    """
    try:
        yield
    except MissingError as error:
        raise _error(out, error.key) from error
    except KeyError as error:
        if not error.args or error.args[0] not in keys:
            raise
        raise _error(out, str(error.args[0])) from error
    except FileNotFoundError as error:
        if error.filename is None or not Path(str(error.filename)).absolute().is_relative_to(out.absolute()):
            raise
        raise _error(out, Path(str(error.filename)).absolute().relative_to(out.absolute())) from error


def _error(out: Path, what: object) -> ArtifactError:
    return ArtifactError(
        f"{out}: {what} has disappeared while the run needed it; the same command makes it again"
    )
