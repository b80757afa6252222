"""Every command that waits for a router prints why it is not reached."""

import pytest
from builders.unreached_router import check_unreached_router


@pytest.mark.parametrize(
    "arguments",
    [
        "c2 watch",
        "c2 comment uuv-1/AAAA --vessel vessel-1 --timeout 0.1",
        "status --interval 0.1",
        "status --interval 0.1 --json",
        "metrics --port 0",
    ],
)
def test_reason_is_printed_without_verbosity(arguments):
    check_unreached_router(arguments)
