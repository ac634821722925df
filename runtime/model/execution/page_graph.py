"""Graphs that decode a page: one that is run once, or an estimator's, whose step is repeated."""

from lightpage.errors import BundleError, InvalidInputError, raised_as
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import DECODER, ESTIMATOR_FILES
from lightpage.runtime.model.execution.estimator_graph import EstimatorFiles, EstimatorGraph
from lightpage.runtime.model.execution.providers import ON_CPU, Provider
from lightpage.runtime.model.execution.table_graph import GraphFile, TableGraph, check_table

PageGraph = TableGraph | EstimatorGraph
REGISTRATION = "registration"
PAGE_INPUTS = frozenset([REGISTRATION])
"""Table inputs that may differ from page to page, as the image shifts. All others are built into the graph."""


def open_graph(
    bundle: Bundle, threads: int | None = None, provider: Provider = ON_CPU, steps: int | None = None
) -> PageGraph:
    """The graph of a bundle's decoder with the bundle's table.

    Args:
        bundle: opened bundle.
        threads: threads of one run.
        provider: provider that computes pages.
        steps: steps of an estimator; None for as many as the bundle has.

    Raises:
        BundleError: no ONNX model, or its table is not the one of the manifest, or does not fit.
        InvalidInputError: `steps` of a bundle that takes none, or more than it has.
        ProviderError: there is no such provider here.
    """
    subject = f"{bundle.subject}: {DECODER}"
    file = GraphFile(bundle.files[DECODER], subject)
    if set(file.table_inputs) != set(bundle.manifest.table_inputs):
        raise BundleError(f"{subject}: table inputs", sorted(file.table_inputs), sorted(bundle.manifest.table_inputs))
    if bundle.files.keys() >= set(ESTIMATOR_FILES):
        with raised_as(BundleError, InvalidInputError, about=f"{bundle.subject}: "):
            check_table(file.table_inputs, bundle.table)
        files = EstimatorFiles(*(bundle.files[name] for name in ESTIMATOR_FILES))
        return EstimatorGraph(files, file, bundle.subject, threads, bundle.table, provider=provider, steps=steps)
    if steps is not None:
        raise InvalidInputError(f"{bundle.subject}: steps", steps, "none: its decoder is a network")
    with raised_as(BundleError, InvalidInputError, about=f"{bundle.subject}: "):
        return TableGraph(file, subject, PAGE_INPUTS, threads, bundle.table, provider=provider)
