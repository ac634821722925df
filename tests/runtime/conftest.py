"""Fixtures of the runtime's tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from runtime.bundle.bundle import Bundle
from runtime.decoding.decoder import Decoder
from tests.runtime import toy


@pytest.fixture(scope="session")
def toy_zip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy.write_toy_bundle(tmp_path_factory.mktemp("bundle") / "toy.zip")


@pytest.fixture(scope="session")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy.write_toy_bundle(tmp_path_factory.mktemp("bundle") / "toy")


@pytest.fixture(scope="session")
def decoder(toy_zip: Path) -> Decoder:
    return Decoder(Bundle.open(toy_zip), threads=1)
