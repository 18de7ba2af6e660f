"""What each process loads, which no linter sees where modules are imported by name."""

import subprocess
import sys
from contextlib import contextmanager

import pytest

from benchmarks.start import PROGRAMS, loaded, started
from runtime.ipc.session_state import SessionState
from tests.crash.lab import Lab
from tests.processes import PATIENCE_S
from tests.sources import ROOT

BASE = {"msgpack", "numpy", "zmq"}
HEAVY = {"PIL", "av", "cv2", "jax", "numba", "pyarrow", "pydantic", "scipy", "simplejpeg", "websockets"}
HEAVY |= {"django", "evaweb", "h5py", "psutil", "torch"}
READING = {
    "robots",
    "runtime.benches",
    "runtime.config",
    "runtime.core",
    "runtime.ipc",
    "runtime.motion",
    "runtime.processes",
}
READING |= {
    "runtime.recording",
    "runtime.safety",
    "runtime.station",
    "runtime.strategies",
    "runtime.transports",
}
READING |= {"runtime.kinematics"}
# By process: the parts of ours that it loads, and what of others beside numpy, zmq and msgpack.
PARTS = {
    "guard": ({"runtime.core", "runtime.ipc", "runtime.processes"}, set()),
    "control": (READING | {"runtime.spaces"}, {"pydantic"}),
    "reception": (READING, {"pydantic", "cv2"}),
    "media": (READING | {"runtime.spaces"}, {"pydantic", "av", "cv2", "pyarrow", "simplejpeg"}),
    "coordinator": (
        READING
        | {
            "runtime.cameras",
            "runtime.lerobot",
            "runtime.policies",
            "runtime.spaces",
            "runtime.teleoperators",
        },
        {"pydantic", "PIL", "cv2", "numba", "scipy", "websockets"},
    ),
    "supervisor": (
        READING | {"runtime.link", "runtime.policies", "runtime.spaces"},
        {"pydantic", "av", "websockets"},  # which checks the address of a policy server
    ),
}
# Modules of variants: of the kinds that the deployment names, and what these stand on.
BACKENDS = {"runtime.kinematics.compiled", "runtime.kinematics.pyroki", "runtime.kinematics.kernels"}
BROKEN = (
    "runtime.policies.lerobot",
    "runtime.policies.gr00t",
    "runtime.teleoperators.ros2",
    "runtime.transports.ros1",
)


def programs_modules(module):
    """Names of all modules that are there once `module` is imported."""
    code = f"import sys, {module}; print(*sorted(sys.modules))"
    told = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return told.stdout.split()


@contextmanager
def bench(folder):
    """A node and a policy server for a station of real processes."""
    lab = Lab(folder)
    try:
        yield lab.node().server()
    finally:
        for child in lab.children.values():
            child.stdin.close()
            child.wait(PATIENCE_S)


@pytest.fixture(scope="module")
def story(tmp_path_factory):
    """A station that runs and is stopped while modules of others are broken: where it was, and its files."""
    folder, states = tmp_path_factory.mktemp("story"), []
    with bench(folder) as lab:
        policy = f'policy.url="{lab.addresses["server"]["url"]}"'
        with started(
            lab.addresses["node"], folder / "station", policy, "bus.preview_rate=0", broken=",".join(BROKEN)
        ) as station:
            client = station.client
            client.command("setup")
            states.append(client.wait(lambda seen: seen["state"] != SessionState.SETTING_UP, PATIENCE_S))
            client.command("run")
            states.append(client.wait(lambda seen: seen["policy"]["answers"] > 3, PATIENCE_S))
            client.estop("a test")
            states.append(client.wait(lambda seen: seen["state"] == SessionState.FAULTED, PATIENCE_S))
    return folder / "station", states


@pytest.mark.lab
@pytest.mark.slow
def test_a_station_starts_runs_and_stops_where_modules_of_other_kinds_are_broken(story):
    _, states = story
    assert [seen["state"] for seen in states] == [
        SessionState.READY,
        SessionState.RUNNING,
        SessionState.FAULTED,
    ]


@pytest.mark.lab
@pytest.mark.slow
@pytest.mark.parametrize("process", PROGRAMS)
def test_each_process_loads_what_its_list_has(story, process):
    modules = loaded(story[0], process)
    parts, others = PARTS[process]
    ours = {".".join(name.split(".")[:2]) for name in modules if name.startswith("runtime.")}
    ours |= {"robots"} & set(modules)
    assert ours - {"runtime.__main__"} == parts
    roots = {name.partition(".")[0] for name in modules}
    assert roots & (HEAVY | BASE) <= others | BASE
    assert roots >= BASE


@pytest.mark.lab
@pytest.mark.slow
def test_control_loads_its_transport_and_no_policy_leader_camera_or_solver(story):
    modules = set(loaded(story[0], "control"))
    assert {name for name in modules if name.startswith("runtime.kinematics.")} == {"runtime.kinematics.base"}
    kinds = {f"runtime.transports.{kind}" for kind in ("dataset", "lerobot", "ros1", "ros2", "zmq")}
    assert kinds & modules == {"runtime.transports.zmq"}


@pytest.mark.lab
@pytest.mark.slow
def test_no_process_loads_a_kind_that_the_deployment_does_not_name(story):
    for process in PROGRAMS:
        modules = set(loaded(story[0], process))
        assert not modules & set(BROKEN), process
        assert modules & BACKENDS <= {"runtime.kinematics.compiled", "runtime.kinematics.kernels"}, process


def test_a_kind_that_cannot_be_loaded_is_refused_where_a_deployment_names_it(tmp_path):
    """By `python -m runtime`, before anything starts, with file and cause."""
    broken = "sys.modules['runtime.policies.async_inference'] = None"  # which lerobot alone stands on
    code = f"import sys; {broken}; from runtime.__main__ import main; sys.exit(main())"
    words = ["deployments/tabletop.toml", "--check", "--set", f'data_dir="{tmp_path}"']
    ends = [
        "--set",
        'transport.sub_endpoint="tcp://127.0.0.1:1"',
        "--set",
        'transport.pub_endpoint="tcp://127.0.0.1:1"',
    ]
    for kind, refused in (("openpi", False), ("lerobot", True)):
        asked = ["--set", f"policy.kind={kind}", "--set", 'policy.url="ws://127.0.0.1:1"']
        told = subprocess.run(
            [sys.executable, "-c", code, *words, *ends, *asked], cwd=ROOT, capture_output=True, text=True
        )
        assert told.returncode == (2 if refused else 0), told.stderr
        if refused:
            assert "policies: the kind 'lerobot' cannot be loaded" in told.stderr
            assert "runtime/policies/lerobot.py: ModuleNotFoundError" in told.stderr


@pytest.mark.parametrize(
    "module",
    [
        "runtime.config.schema",
        "runtime.processes.control.process",
        "runtime.processes.reception.process",
        "runtime.processes.coordinator.process",
        "runtime.processes.guard.process",
        "runtime.ctl",
        "runtime.link.station",
    ],
)
def test_what_stops_a_robot_is_free_of_codecs_and_tables(module):
    assert not {"av", "pyarrow", "PIL", "websockets", "simplejpeg"} & set(programs_modules(module))
