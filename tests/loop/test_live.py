"""The loops of docs/how/opcua.md, against a real server, and of docs/how/ros2.md, without ROS."""

import re
import socket
import sys
import threading
import time
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import koopmpc as km
from tests.docs.page import DOCS, alike, blocks, run


@pytest.fixture
def tank():
    """The server of the page at a free port, and the page's plant that talks to it."""
    pytest.importorskip("asyncua", reason="the extra opcua is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    server, client = (block.source.replace("48410", port) for block in blocks("how/opcua.md"))
    names: dict = {"__name__": "page"}
    exec(server, names)
    exec(client.partition("\nplant = ")[0], names)
    url = f"opc.tcp://127.0.0.1:{port}"
    it = SimpleNamespace(**names, plant=names["OPCUATank"](url), runs=True)
    yield it
    it.open_valve.set()
    it.tank.join()
    it.plant.client.disconnect()
    if it.runs:
        it.server.stop()


def loop(tank, steps, recorder=None, mpc=None, reference=(0.8,), watchdog=20.0):
    return km.realtime(
        mpc or tank.mpc, tank.plant, dt=0.05, reference=reference, steps=steps, safe=[0.0], watchdog=watchdog,
        recorder=recorder,
    )  # fmt: skip


@pytest.mark.slow
def test_the_page_of_opcua_prints_what_it_shows(tmp_path):
    pytest.importorskip("asyncua", reason="the extra opcua is not installed")
    for shown, printed in run("how/opcua.md", tmp_path)[1]:
        assert alike(shown, printed), printed


def test_bad_quality_and_old_values_are_bad_measurements_and_every_step_beats_once(tank):
    ua, seen = tank.ua, []
    broken = ua.DataValue(ua.Variant(0.5), ua.StatusCode(ua.StatusCodes.BadSensorFailure))
    tank.open_valve.set()  # the tank rests: this test alone writes the level
    tank.tank.join()
    tank.level.write_value(0.5)
    tank.plant.stale = 60.0  # a busy machine may take a second for a few steps

    def watch(step):
        if step.move.status is km.Status.TIME_LIMIT:
            return  # a busy machine: the time of this step had passed, and nothing was measured or applied
        done = len(seen)
        seen.append((step.move.status, step.u[0], tank.inflow.read_value(), tank.beat.read_value()))
        if done == 2:
            tank.level.write_value(broken)
        if done == 5:
            tank.level.write_value(0.55)
        tank.plant.stale = 0.02 if done == 8 else 60.0

    paced = loop(tank, 60, watch)
    assert (len(seen), paced.steps + paced.skipped) == (paced.steps, 60)
    bad = [status is km.Status.BAD_MEASUREMENT for status, *_ in seen]
    assert bad[:12] == [k in (3, 4, 5, 9) for k in range(12)]
    assert not any(bad[12:])
    assert all(0 <= u <= 2 and written == u and beats == k + 1 for k, (_, u, written, beats) in enumerate(seen))
    assert tank.inflow.read_value() == 0.0


def test_a_server_that_goes_ends_the_loop_and_is_named(tank):
    def stop(step):
        if step.k == 3:
            tank.open_valve.set()
            tank.tank.join()
            tank.server.stop()
            tank.runs = False

    paced = loop(tank, 100, stop)
    assert paced.ended.startswith("plant: ")
    assert "the safe input did not reach it" in paced.ended
    assert paced.steps < 10


@pytest.mark.slow
def test_a_controller_that_hangs_is_made_safe_by_the_watchdog(tank):
    class Hanging:
        dt, nu, horizon, calls = tank.mpc.dt, 1, tank.mpc.horizon, 0

        def reset(self, x0=None, u_prev=None):
            tank.mpc.reset()

        def __call__(self, y, reference, applied=None, w=None):
            self.calls += 1
            if self.calls > 3:
                time.sleep(20)
            return tank.mpc(y, reference)

    began = time.monotonic()
    paced = loop(tank, 100, mpc=Hanging(), watchdog=1.0)
    assert paced.ended == "watchdog: the controller did not return within 1 s"
    assert time.monotonic() - began < 15
    assert tank.inflow.read_value() == 0.0


@pytest.fixture
def ros():
    names: dict = {"__name__": "page"}
    exec(blocks("how/ros2.md")[0].source, names)
    plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.02)
    mpc = km.LinearMPC(plant, [0, 0], [0], km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-20, u_max=20), horizon=30)
    return names, mpc


def test_the_page_of_ros_prints_what_it_shows(tmp_path):
    for shown, printed in run("how/ros2.md", tmp_path)[1]:
        assert alike(shown, printed), printed


def test_the_loop_body_waits_takes_the_newest_and_is_safe_where_the_sensor_is_silent(ros):
    names, mpc = ros
    body = names["ControlLoop"](mpc, safe=[1.5])
    assert body.tick(0.0)[1] == "waiting"
    body.measure([0.3, 0.0], stamp=1.0)
    assert body.tick(1.0)[1] == "waiting"
    body.reference = [0.0, 0.0]
    u, status = body.tick(1.0)
    assert (u.tolist(), status) == (mpc([0.3, 0.0], [0.0, 0.0]).u.tolist(), "UNCONSTRAINED")
    body.measure([9.0, 9.0], stamp=0.5)  # it was overtaken
    assert body.tick(1.1)[0].tolist() == u.tolist()
    u, status = body.tick(1.3)
    assert (u.tolist(), status) == ([1.5], "BAD_MEASUREMENT")
    body.measure([0.2, 0.0], stamp=1.3)
    assert body.tick(1.3)[1] == "UNCONSTRAINED"


def test_the_node_passes_messages_to_the_loop_body_and_its_answers_back(ros, tmp_path, monkeypatch):
    names, mpc = ros
    monkeypatch.chdir(tmp_path)
    mpc.save("controller.npz")
    sent, timers, nodes = [], [], []

    class Node:
        def __init__(self, name):
            nodes.append(self)

        def create_publisher(self, kind, topic, depth):
            assert (topic, depth) == ("command", 1)
            return SimpleNamespace(publish=lambda message: sent.append(message.data))

        def create_subscription(self, kind, topic, call, depth):
            setattr(self, topic, call)

        def create_timer(self, period, call):
            timers.append((period, call))

        def get_clock(self):
            return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=5_100_000_000))

    def module(name, **held):
        made = ModuleType(name)
        made.__dict__.update(held)
        monkeypatch.setitem(sys.modules, name, made)

    kind = lambda **fields: SimpleNamespace(**fields)  # noqa: E731
    module("rclpy", init=lambda: None, spin=lambda node: None)
    module("rclpy.node", Node=Node)
    module("sensor_msgs.msg", JointState=kind)
    module("std_msgs.msg", Float64MultiArray=kind)
    text = (DOCS / "how" / "ros2.md").read_text(encoding="utf-8")
    exec(re.search(r"```text\n(import rclpy.*?)```", text, re.DOTALL)[1], names)
    ((period, tick),) = timers
    assert period == mpc.dt
    tick()
    stamp = SimpleNamespace(sec=5, nanosec=50_000_000)
    nodes[0].joint_states(kind(header=SimpleNamespace(stamp=stamp), position=[0.3], velocity=[0.0]))
    nodes[0].reference(kind(data=[0.0, 0.0]))
    tick()
    assert sent == [[0.0], mpc([0.3, 0.0], [0.0, 0.0]).u.tolist()]
    assert threading.active_count() < 50
    assert np.isfinite(sent[1]).all()
