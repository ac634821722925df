"""The list of faults fits today's files."""

from __future__ import annotations

import pytest

from tests.planted.draw import AREAS, COUNT, KINDS
from tests.planted.faults import ROOT, Fault, load

FAULTS, STRUCK = load()


def test_the_list_is_spread_over_areas_and_kinds() -> None:
    assert len({fault.id for fault in FAULTS}) == len(FAULTS) == COUNT
    for names, taken in (
        (list(AREAS), [fault.area for fault in FAULTS]),
        (list(KINDS), [fault.kind for fault in FAULTS]),
    ):
        assert {taken.count(name) - len(taken) // len(names) for name in names} <= {-1, 0, 1}
    assert all(fault.reason for fault in STRUCK)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.id)
def test_a_fault_has_its_line_and_its_tests(fault: Fault) -> None:
    assert fault.planted()
    assert fault.tests
    assert [name for name in fault.tests if not (ROOT / name).is_file()] == []
