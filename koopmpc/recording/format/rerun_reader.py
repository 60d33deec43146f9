# pyright: basic
"""The door to Rerun's reader, which may end the process on a damaged file: such a file is read in a child process.

Run as a module, this file is that child: it reads a log and writes its columns to its standard output.
"""

import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from koopmpc.errors import LogError

_REFUSED = 3  # exit code of a child whose reader said why
_PATIENCE, _RATE = 60.0, 1e6  # [s], and [bytes/s] on top of it, for a child to read a file


class Column(NamedTuple):
    """A component of an entity in one chunk: `k` are its steps, None where it is static; `values` an Arrow array."""

    entity: str
    component: str
    k: Any
    values: Any


def read(path: Path, entities: tuple[str, ...]) -> list[Column]:
    """Return the columns of these entities, read in this process."""
    import warnings

    import pyarrow as pa
    from rerun.chunk import RrdReader

    found: list[Column] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # load_run itself warns of a missing end
        for chunk in RrdReader(path).stream().filter(content=list(entities)).to_chunks():
            if not chunk.is_static and "step" not in chunk.timeline_names:
                continue  # not written by koopmpc
            batch = chunk.to_record_batch()
            k = None if chunk.is_static else batch.column("step").cast(pa.int64())
            for name in batch.schema.names:
                metadata = batch.schema.field(name).metadata or {}
                if metadata.get(b"rerun:kind") == b"data":
                    found.append(Column(chunk.entity_path, name.split(":")[-1], k, batch.column(name)))
    return found


def read_in_child(path: Path, entities: tuple[str, ...], told: Path) -> list[Column]:
    """Return the columns of these entities, read in a child process; messages call the file `told`.

    Raises
    ------
    LogError
        Rerun's reader refuses the file, or ended the child.
    """
    import pyarrow as pa

    command = [sys.executable, "-P", "-m", __name__, str(path), *entities]
    places = [os.path.abspath(place) for place in sys.path if place]  # noqa: PTH100  # an entry may be a .zip
    patience = _PATIENCE + path.stat().st_size / _RATE
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=patience,
            check=False,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(places)},
        )
    except subprocess.TimeoutExpired as error:
        raise LogError(f"{told} is damaged: reading it did not end within {patience:.0f} s") from error
    if done.returncode == _REFUSED:
        raise LogError(f"{told} is no log, or is damaged: {done.stdout.decode(errors='replace')}")
    if done.returncode:
        raise LogError(f"{told} is damaged, beyond what can be read: the process that read it ended on it")
    try:
        return list(_received(done.stdout))
    except (pa.ArrowException, KeyError, IndexError) as error:
        raise LogError(f"{told} is damaged: {error}") from error


def _send(columns: Iterable[Column], out: Any) -> None:
    """Write one Arrow stream for each column."""
    import pyarrow as pa

    for column in columns:
        arrays, names = [column.values], ["values"]
        if column.k is not None:
            arrays, names = [*arrays, column.k], [*names, "k"]
        batch = pa.record_batch(arrays, names=names)
        batch = batch.replace_schema_metadata({"entity": column.entity, "component": column.component})
        with pa.ipc.new_stream(out, batch.schema) as stream:
            stream.write_batch(batch)


def _received(data: bytes) -> Iterator[Column]:
    import pyarrow as pa

    source = pa.BufferReader(data)
    while source.tell() < len(data):
        with pa.ipc.open_stream(source) as stream:
            batch = stream.read_next_batch()
            stream.read_all()
        about = batch.schema.metadata
        k = batch.column("k") if "k" in batch.schema.names else None
        yield Column(about[b"entity"].decode(), about[b"component"].decode(), k, batch.column("values"))


def _main() -> int:
    """Answer on a copy of the standard output: what a library prints goes elsewhere."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    path, *entities = sys.argv[1:]
    try:
        columns = read(Path(path), tuple(entities))
    except BaseException as error:  # a panic of Rerun's reader is no Exception
        out.write(str(error).partition("\n")[0].encode())
        out.flush()
        return _REFUSED
    _send(columns, out)
    out.flush()
    return 0


if __name__ == "__main__":
    code = _main()
    os._exit(code)  # threads of the reader may not end
