"""The course of the benchmark: each preset in batches, then the product around one of them, as far as there is time."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from analysis.gpu.from_bundle import Served, page_codes
from analysis.gpu.in_batches import Machine, ceilings, constants_of, decoded, floor
from analysis.gpu.kept_form import form_of, scene_of
from analysis.gpu.kept_parts import Kept
from lightpage.runtime.model.execution.providers import Provider

_CEILINGS_S, _SCENE_S, _FORM_S, _BATCH_S = 15.0, 90.0, 45.0, 25.0
_CODE_S, _BUNDLE_S, _SERVICE_S, _BULK_S = 45.0, 150.0, 120.0, 120.0
"""Time that parts are taken to need before one of their kind is done."""


class Course:
    """Measures parts of the benchmark.

    Args:
        kept: takes the results.
        folder: folder of the data set with kept decoders.
        provider: provider that computes pages.
        reflections: rounds to the field of the slower presets.
        simulated: folder for simulated pages.
    """

    def __init__(self, kept: Kept, folder: Path, provider: Provider, reflections: int, simulated: Path) -> None:
        self._kept, self._folder, self._provider, self._reflections = kept, folder, provider, reflections
        self._machine = Machine.of(str(provider))
        kept.part("ceilings", _CEILINGS_S, partial(ceilings, self._machine))
        with kept.timed("scene"):
            self._scene = scene_of(folder, simulated)

    @property
    def page(self) -> str:
        """Kind of the pages, as `analysis.codec.speed.PAGES` names it."""
        profile = self._scene.profile
        size = f"{profile.page.symbol_size_px}x{profile.page.symbol_size_px}"
        return f"{'full size' if profile.name == 'paper' else profile.name} {size}"

    def measure(self, preset: str, batches: tuple[int, ...]) -> None:
        """Measure all parts of one preset that are not there."""
        kept, machine, scene = self._kept, self._machine, self._scene
        names = {f"{preset}, {pages} a batch": pages for pages in batches}
        form_name = f"{preset}, form"
        if all(name in kept.parts for name in names) or not kept.fits(form_name, _FORM_S):
            return
        with kept.timed(form_name):
            form = form_of(self._folder, scene, preset, self._reflections, machine.device)
            constants = constants_of(form)
        files = {"constants": len(form.constants), "batch": len(form.batch)}
        told = {"files": files, "bytes": sum(value.nbytes for value in constants.values())}
        kept.part(f"{preset}, present", 0.0, lambda: form.told)
        kept.part(f"{preset}, constants", 0.0, lambda: told)
        kept.part(f"{preset}, floor", 0.0, lambda: floor(form, max(batches), kept.parts["ceilings"]))
        for name, pages in names.items():
            kept.part(name, _BATCH_S, partial(decoded, machine, form, constants, pages, scene))

    def measure_product(self, largest: int, out: Path) -> None:
        """Measure the page code, and bundle, service and bulk with the preset in the middle.

        Args:
            largest: pages of a batch at most.
            out: folder for the bundle and the recording.
        """
        kept = self._kept
        kept.part("page code", _CODE_S, page_codes)
        served = Served(self._folder, self._scene, self._reflections, self._provider, largest, out)
        if kept.part("bundle", _BUNDLE_S, served.bundle) is not None:
            kept.part("service", _SERVICE_S, lambda: served.through_service(kept.left_s))
            kept.part("bulk", _BULK_S, lambda: served.bulk(kept.left_s))
