"""Where an emitted kernel can be run: on the host, and on the cores where the cross tools are here."""

import os

import pytest

from qrl.export.targets import CORES

M0, M3, M4F, M7, M33, M55, RV32IMC, RV32EC = CORES
BODIES = M0, M4F, M55, RV32IMC  # one for each body of the template: Armv6-M, Arm DSP, Helium, C99
# For the fixture `core`: None is the host.
EACH = pytest.mark.parametrize("core", CORES, ids=[core.name for core in CORES], indirect=True)
EITHER = pytest.mark.parametrize("core", [None, *BODIES], ids=["host", "M0", "M4F", "M55", "RV32IMC"], indirect=True)


def need(missing: list[str]) -> None:
    """Skip the test where something is missing; fail it where QRL_REQUIRE_CROSS=1 says that nothing may be."""
    if missing and os.environ.get("QRL_REQUIRE_CROSS") == "1":
        pytest.fail(f"QRL_REQUIRE_CROSS=1, and missing here: {', '.join(missing)}")
    if missing:
        pytest.skip(f"missing here: {', '.join(missing)}")
