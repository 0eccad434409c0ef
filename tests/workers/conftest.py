"""Workers that tests start in their own process are forked, too."""

import pytest
from forked import fork_workers


@pytest.fixture(scope="package", autouse=True)
def _forked_workers():
    with pytest.MonkeyPatch.context() as patch:
        fork_workers(patch.setattr)
        yield
