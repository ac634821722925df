"""The list of faults fits today's files."""

import pytest

from tests.planted.draw import COUNT
from tests.planted.faults import ROOT, Fault, load

FAULTS = load("fault")


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.id)
def test_each_fault_has_its_line_and_its_tests(fault: Fault) -> None:
    assert len({other.id for other in FAULTS}) == COUNT
    assert fault.planted()
    assert fault.tests
    assert [name for name in fault.tests if not (ROOT / name.partition("::")[0]).is_file()] == []
