"""A log as Rerun's own reader gives it: what stands at an entity, by component."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np


class Logged:
    """The columns of an .rrd; an entity begins without a slash."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        self.columns: dict[tuple[str, str], list[tuple[int, list[Any]]]] = {}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a log that grew
            chunks = RrdReader(path).stream().to_chunks()
        for chunk in chunks:
            batch = chunk.to_record_batch()
            steps = batch.column("step").to_pylist() if "step" in batch.schema.names else [-1] * batch.num_rows
            for name in batch.schema.names:
                if (batch.schema.field(name).metadata or {}).get(b"rerun:kind") == b"data":
                    key = chunk.entity_path[1:], name.split(":")[-1]
                    rows = zip(steps, batch.column(name).to_pylist(), strict=True)
                    self.columns.setdefault(key, []).extend(row for row in rows if row[1])

    @property
    def entities(self) -> set[str]:
        return {entity for entity, _ in self.columns}

    def rows(self, entity: str, component: str = "scalars") -> tuple[list[int], list[Any]]:
        """Return the steps in their order, and the values of each."""
        rows = sorted(self.columns.get((entity, component), []), key=lambda row: row[0])
        return [k for k, _ in rows], [values for _, values in rows]

    def matrix(self, entity: str) -> tuple[np.ndarray, np.ndarray]:
        steps, values = self.rows(entity)
        return np.array(steps, dtype=int), np.array(values, dtype=float)

    def static(self, entity: str, component: str) -> list[Any]:
        """Return the values of what does not change."""
        return self.rows(entity, component)[1][-1]
