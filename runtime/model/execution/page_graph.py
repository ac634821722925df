"""Graphs that decode a page: one that is run once, or an estimator's, whose step is repeated."""

from lightpage.errors import BundleError, InvalidInputError, raised_as
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import DECODER, EARLY, FIRST, OPERATORS, STEP
from lightpage.runtime.model.execution.estimator_graph import EstimatorFiles, EstimatorGraph, most_steps
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
        steps: largest number of steps of an estimator; None for as many as the bundle has.

    Raises:
        BundleError: no ONNX model, or its table is not the one of the manifest, or does not fit.
        InvalidInputError: fewer `steps` than one.
        ProviderError: there is no such provider here.
    """
    if steps is not None and steps < 1:
        raise InvalidInputError("steps", steps, "1 or more")
    subject = f"{bundle.subject}: {DECODER}"
    file = GraphFile(bundle.files[DECODER], subject)
    if set(file.table_inputs) != set(bundle.manifest.table_inputs):
        raise BundleError(f"{subject}: table inputs", sorted(file.table_inputs), sorted(bundle.manifest.table_inputs))
    if bundle.is_estimator:
        with raised_as(BundleError, InvalidInputError, about=f"{bundle.subject}: "):
            check_table(file.table_inputs, bundle.table)
            held = bundle.files
            files = EstimatorFiles(held[OPERATORS], held[FIRST], held[EARLY], held[STEP], {DECODER: held[DECODER]})
            return EstimatorGraph(files, file, bundle.subject, threads, bundle.table, provider=provider, steps=steps)
    with raised_as(BundleError, InvalidInputError, about=f"{bundle.subject}: "):
        return TableGraph(file, subject, PAGE_INPUTS, threads, bundle.table, provider=provider)


def steps_of(bundle: Bundle) -> int:
    """Number of Gauss-Newton steps that a bundle has for a page; 0 where its decoder is a network.

    Raises:
        BundleError: its decoder is no ONNX model, or lacks the noise of its steps.
    """
    if not bundle.is_estimator:
        return 0
    subject = f"{bundle.subject}: {DECODER}"
    ports = GraphFile(bundle.files[DECODER], subject).table_inputs
    return most_steps(ports, subject)


def check_steps(bundle: Bundle, steps: int | None) -> None:
    """Check that a bundle has so many Gauss-Newton steps for a page; None is whatever it has.

    Raises:
        InvalidInputError: it has fewer, or its decoder is a network.
        BundleError: see `steps_of`.
    """
    if steps is None:
        return
    most = steps_of(bundle)
    if most == 0:
        raise InvalidInputError(f"{bundle.subject}: steps", steps, "none: its decoder is a network")
    if not 1 <= steps <= most:
        raise InvalidInputError(f"{bundle.subject}: steps", steps, f"1 to {most}, as the bundle has")


def check_ports(bundle: Bundle, graph: PageGraph) -> None:
    """Check names, types and shapes of a graph's frames and outputs against the manifest and the profile.

    Raises:
        BundleError: they are others.
    """
    manifest, profile, subject = bundle.manifest, bundle.profile, f"{bundle.subject}: {DECODER}"
    inputs = graph.inputs
    if set(inputs) != {"in_phase", "quadrature"}:
        raise BundleError(f"{subject}: inputs", sorted(inputs), "in_phase and quadrature")
    for name, port in inputs.items():
        if not port.admits(manifest.frame_dtype, profile.frame_shape):
            expected = f"{manifest.frame_dtype} {profile.frame_shape}"
            raise BundleError(f"{subject}: input {name}", f"{port.dtype} {port.shape}", expected)
    outputs = graph.outputs
    shapes = {"p": (2, *profile.page_shape), "phase": profile.page_shape, "concentration": profile.page_shape}
    for name, shape in shapes.items():
        if name not in outputs or not outputs[name].admits("float32", shape):
            got = f"{outputs[name].dtype} {outputs[name].shape}" if name in outputs else "nothing"
            raise BundleError(f"{subject}: output {name}", got, f"float32 {shape}")
    if manifest.residual_output is not None and manifest.residual_output not in outputs:
        raise BundleError(f"{subject}: output {manifest.residual_output}", "nothing", "a scalar residual")
