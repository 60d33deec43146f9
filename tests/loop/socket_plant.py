"""A mass on a spring in a process of its own, in real time, behind a socket; and the plant object that talks to it."""

import json
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path


class SocketPlant:
    """x = [position, speed] of a damped mass on a spring; `step` sends an input, `read` asks for the state."""

    states = outputs = ("p [m]", "v [m/s]")
    inputs = ("u [N]",)
    state = None

    def __init__(self, port, dt):
        self.dt = dt
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=30)
        self._file = self._socket.makefile("r")

    def close(self):
        self._file.close()
        self._socket.close()

    def reset(self, x0, rng):
        return self._asked(reset=list(map(float, x0)))

    def read(self):
        return self._asked()

    def step(self, u):
        self._asked(u=float(u[0]))

    def stop(self, u):
        self._sent(stop=float(u[0]))

    def _asked(self, **message):
        self._sent(**message)
        line = self._file.readline()
        if not line:
            raise ConnectionError("the plant closed the connection")
        return json.loads(line)

    def _sent(self, **message):
        self._socket.sendall((json.dumps(message) + "\n").encode())


@contextmanager
def started(folder):
    """Yield the plant's process, its port, and the file in which it notes each message; kill it at the end."""
    heard = Path(folder) / "heard.jsonl"
    process = subprocess.Popen([sys.executable, __file__, str(heard)], stdout=subprocess.PIPE, text=True)
    try:
        yield process, int(process.stdout.readline()), heard
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def inputs_in(heard):
    """Return the inputs that the plant was given, as (kind, value)."""
    lines = [json.loads(line) for line in heard.read_text().splitlines()]
    return [(kind, value) for line in lines for kind, value in line.items() if kind in ("u", "stop")]


def serve(path):
    """Integrate p'' = u - p - v over the time that has passed whenever a message comes, and answer with [p, v]."""
    listening = socket.create_server(("127.0.0.1", 0))
    print(listening.getsockname()[1], flush=True)  # noqa: T201
    connection, _ = listening.accept()
    p = v = u = 0.0
    seen = time.monotonic()
    with connection.makefile("r") as stream, open(path, "a") as notes:  # noqa: PTH123
        for line in stream:
            now = time.monotonic()
            while seen < now:
                p, v, seen = p + 1e-3 * v, v + 1e-3 * (u - p - v), seen + 1e-3
            message = json.loads(line)
            p, v = message.get("reset", (p, v))
            u = message.get("u", message.get("stop", u))
            notes.write(line)
            notes.flush()
            if "stop" not in message:
                connection.sendall((json.dumps([p, v]) + "\n").encode())


if __name__ == "__main__":
    serve(sys.argv[1])
