"""A decoder's graph opened with one table: what follows from it is computed once, and fed with each page."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.sampling_table import SamplingTable
from lightpage.errors import InvalidInputError
from lightpage.runtime.model.execution.constant_table import GraphFile
from lightpage.runtime.model.execution.providers import ON_CPU, Provider
from lightpage.runtime.model.execution.session import BoundSession, Port, Session, open_session, running


class TableGraph:
    """A graph and its table. It never changes; its methods may be called from many threads at once.

    Args:
        file: the graph as stored.
        subject: what it is, for errors.
        fed: names of table inputs that stay inputs, and are fed.
        threads: threads of one run; by default the cores that this process may use.
        table: values instead of the graph's defaults.
        like: the same graph with another table: what runs for every page is shared with it.
        profile: see `open_session`.
        provider: what pages are computed with; what is computed once is computed on the CPU.

    Raises:
        InvalidInputError: a table that does not fit.
        BundleError: the graph cannot be run.
        ProviderError: there is no such provider here.
    """

    def __init__(
        self,
        file: GraphFile,
        subject: str,
        fed: Collection[str],
        threads: int | None,
        table: SamplingTable | None = None,
        like: TableGraph | None = None,
        profile: Path | None = None,
        provider: Provider = ON_CPU,
    ) -> None:
        self._file, self._subject, self._fed_names, self._threads = file, subject, fed, threads
        self.provider = provider
        self.table: SamplingTable = table or {}
        self.check(self.table)
        parts = file.cut(self.table, fed)
        between: dict[str, NDArray[Any]] = {}
        if parts.before is not None:  # else nothing follows from the table alone
            before = open_session(parts.before, subject, threads, once=True)
            with running(subject):
                between = dict(zip(parts.between, before.run(parts.between, {}), strict=True))
        between |= {name: self.value(name) for name in parts.direct}
        fed_values = {name: self.value(name) for name in self.ports.keys() & set(fed)}
        if like is not None and between:
            self.session: Session = like.session
        else:
            model = parts.behind_with(between)
            self.session = open_session(model, subject, threads, profile=profile, provider=provider)
        held = fed_values | between
        self._held = frozenset(held)
        self._bound = BoundSession(self.session, provider, held, subject)

    def with_table(self, table: SamplingTable) -> TableGraph:
        """The graph with other tensors in its table, by name; those left out stay. It raises as the constructor does.

        On a GPU the new table's tensors lie beside those of this one, as long as both are held.
        """
        merged = {**self.table, **table}
        names, threads = self._fed_names, self._threads
        return TableGraph(self._file, self._subject, names, threads, merged, like=self, provider=self.provider)

    @property
    def inputs(self) -> dict[str, Port]:
        """Type and shape of what must be fed with each page, by name."""
        nodes = self.session.get_inputs()
        return {node.name: Port.of(node) for node in nodes if node.name not in self._held}

    @property
    def ports(self) -> Mapping[str, Port]:
        """Type and shape of every tensor of the table, by name."""
        return self._file.table_inputs

    def value(self, name: str) -> NDArray[Any]:
        """A tensor of the table, as the graph is run with it.

        Raises:
            InvalidInputError: no such tensor.
        """
        if name not in self.ports:
            raise InvalidInputError("table", repr(name), f"one of {sorted(self.ports)}")
        return self.table[name] if name in self.table else self._file.default(name)

    def check(self, table: SamplingTable) -> None:
        """Check tensors that are to stand in the table instead of the graph's defaults.

        Raises:
            InvalidInputError: an unknown name, a wrong type or shape, or values that are not finite.
        """
        for name, value in table.items():
            port = self.ports.get(name)
            if port is None:
                raise InvalidInputError("table", repr(name), f"one of {sorted(self.ports)}")
            if not port.admits(str(value.dtype), value.shape):
                raise InvalidInputError(f"table {name}", f"{value.dtype} {value.shape}", f"{port.dtype} {port.shape}")
            if not np.isfinite(value).all():
                raise InvalidInputError(f"table {name}", "NaN or infinity", "finite numbers")

    def run(self, outputs: Sequence[str], feeds: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        """Run the graph; `feeds` holds the frames, and table tensors for this run alone."""
        return self._bound.run(outputs, feeds)
