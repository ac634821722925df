"""The engines of bulk runs by name; what only one of them needs is imported when it is chosen."""

from lightpage.runtime.archives.run.engine import THREADS_OF_WORKER, Engine
from lightpage.runtime.archives.workers.local import LocalEngine
from lightpage.runtime.model.execution.cpus import available_cpus
from lightpage.runtime.model.execution.providers import CPU, Provider

LOCAL, RAY = "local", "ray"


def engine_of(name: str, address: str | None, workers: int | None, threads: int | None, provider: Provider) -> Engine:
    """Return the engine that has the work done.

    Args:
        name: `LOCAL` or `RAY`.
        address: address of a cluster of Ray; None to start one here.
        workers, threads: how many, and of each one's inferences; None for what the machine, or cluster, suffices for.
        provider: provider of the workers.

    Raises:
        ProviderError: there is no such provider here.
        ModuleNotFoundError: Ray is not installed.
    """
    on_gpu = provider.name != CPU
    if name == RAY:
        from lightpage.runtime.archives.workers.ray_engine import RayEngine

        return RayEngine(address, workers, threads, gpus=int(on_gpu))
    if on_gpu:
        from lightpage.runtime.model.execution.session import check_provider  # loads onnxruntime, which takes a while

        check_provider(provider)
    count = workers or (1 if on_gpu else max(1, available_cpus() // THREADS_OF_WORKER))
    return LocalEngine(count, threads or max(1, available_cpus() // count))
