"""Pages come from files, uploads, recordings and simulated devices, by number or in turn."""

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.errors import InvalidInputError, LightpageError, LimitError, PageError, RecordingError, StorageError
from lightpage.page.symbols import pilot_mask
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.pages import Pages
from lightpage.recording.reader import Recording
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.acquisition.recording import RecordingSource
from lightpage.runtime.device.acquisition.simulator import SimulatorSource
from lightpage.runtime.device.acquisition.source import open_source, own_fault
from tests.runtime import toy
from tests.runtime.device.acquisition.lab import pages_of


@pytest.fixture
def recording(tmp_path: Path) -> tuple[Path, np.ndarray]:
    return tmp_path / "r.h5", toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 16, 3)


def test_storage_that_fails_is_no_fault_of_the_source_and_names_the_page(
    recording: tuple[Path, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    fail = Mock(side_effect=StorageError("recording R.h5: dataset 'in_phase'", "Input/output error", "data"))
    source = RecordingSource(recording[0])
    monkeypatch.setattr(Recording, "frames", fail)
    with pytest.raises(StorageError, match=r"^page 1"), own_fault():
        source.shot(page=1)


def test_a_recording_is_read_in_turn_again_and_again_or_by_number(recording: tuple[Path, np.ndarray]) -> None:
    path, symbols = recording
    source = open_source(f"recording:{path}")
    source.check_against(toy.PROFILE)
    with pytest.raises(RecordingError):
        source.check_against(load_profile("bench"))
    assert source.levels == 16
    assert [source.shot().page_index for _ in range(5)] == [0, 1, 2, 0, 1]
    page = source.shot(page=2)
    assert (page.symbols == symbols[2]).all()
    assert page.pair.in_phase.shape == toy.SHAPE
    references = source.references()
    assert references is not None
    assert references.in_phase[0, 0] == toy.OFFSETS[0]
    for wrong in (-1, 3):
        with pytest.raises(PageError, match=r"0\.\.2"):
            source.shot(page=wrong)
    source.close()


class FakeSimulator:
    """Stands in for the wave simulator, which takes seconds a page."""

    def __init__(self, profile: object, device: Device, levels: int, seed: int) -> None:
        self.device, self.profile, self.levels = device, profile, levels

    def set_device(self, device: Device) -> None:
        self.device = device

    def page(self, symbols: np.ndarray) -> FramePair:
        angle = np.array([[self.device.geometry.pipe_angle_deg]])
        return FramePair(angle, angle)


@pytest.fixture
def simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lightpage.simulator.simulator.Simulator", FakeSimulator)


@pytest.mark.usefixtures("simulator")
def test_a_simulated_page_depends_on_seed_and_number_only() -> None:
    one, same, other = (SimulatorSource(toy.PROFILE, Device(), 8, seed) for seed in (1, 1, 2))
    first = [one.shot() for _ in range(3)]
    assert [page.page_index for page in first] == [0, 1, 2]
    again = same.shot(page=2)
    assert again.symbols is not None
    assert again.symbols.tolist() == np.asarray(first[2].symbols).tolist()
    assert again.symbols.tolist() != np.asarray(other.shot(page=2).symbols).tolist()
    assert again.symbols.max() < 8
    assert np.array_equal(np.asarray(again.pilot_mask), pilot_mask(toy.PROFILE))
    with pytest.raises(PageError):
        one.shot(page=-1)
    with pytest.raises(InvalidInputError, match=r"^source simulator"):
        one.check_against(load_profile("bench"))


@pytest.mark.usefixtures("simulator")
def test_a_simulator_is_opened_by_name_with_settings(tmp_path: Path) -> None:
    (tmp_path / "device.toml").write_text("[geometry]\npipe_angle_deg = 0.25\n")
    source = open_source(f"simulator:bench?levels=4&seed=9&device={tmp_path / 'device.toml'}")
    assert isinstance(source, SimulatorSource)
    assert source.levels == 4
    assert source.shot(page=0).pair.in_phase.tolist() == [[0.25]]
    source.set_device(Device())
    assert source.shot(page=0).pair.in_phase.tolist() != [[0.25]]


@pytest.mark.usefixtures("simulator")
@pytest.mark.parametrize(
    ("spec", "named"),
    [
        ("recording:/nonexistent.h5", "nonexistent"),
        ("simulator:bench?levels=many", "whole numbers"),
        ("simulator:bench?colour=red", "colour"),
        ("simulator:bench?seed=-1", "at least 0"),
        ("camera:0", "camera configuration 0"),
        ("tape:1", "recording:FILE"),
    ],
)
def test_what_is_no_source_is_refused_by_name(spec: str, named: str) -> None:
    with pytest.raises(LightpageError, match=named):
        open_source(spec)


def test_uploaded_pages_follow_those_of_the_file(tmp_path: Path) -> None:
    store = pages_of(tmp_path, 2)
    more = np.stack([toy.symbols_of(16, number)[0] for number in (7, 8)])
    store.most_bytes = 2 * more.nbytes
    assert store.append(more, 16) == 2
    assert store.append(more[0], 16) == 4
    assert (len(store), store.levels) == (5, 16)
    for page, number in enumerate((0, 1, 7, 8, 7)):
        assert (store[page] == toy.symbols_of(16, number)[0]).all()
    for wrong in (-1, 5):
        with pytest.raises(PageError):
            store[wrong]
    with pytest.raises(InvalidInputError, match="16"):
        store.append(more % 8, 8)
    with pytest.raises(PageError):
        store.append(more, 4)
    with pytest.raises(LimitError):
        store.append(more, 16)
    assert store.append(more[0], 16) == 5  # exactly full
    store.close()


def test_pages_for_another_profile_are_refused(tmp_path: Path) -> None:
    pages_of(tmp_path).close()
    page = toy.PROFILE.page.model_copy(update={"rows": toy.PROFILE.page.rows + 1})
    with pytest.raises(InvalidInputError):
        PageStore(toy.PROFILE.model_copy(update={"page": page}), Pages.open(tmp_path / "pages.h5"))


def test_levels_of_an_empty_store_are_those_of_the_first_upload_unless_it_was_told() -> None:
    store = PageStore(toy.PROFILE)
    assert (store.levels, store.code, len(store)) == (None, None, 0)
    with pytest.raises(PageError):
        store[0]
    assert store.append(toy.symbols_of(8, 1), 8) == 0
    assert store.levels == 8
    with pytest.raises(InvalidInputError):
        PageStore(toy.PROFILE, levels=16).append(toy.symbols_of(8, 1), 8)
