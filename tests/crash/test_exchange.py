"""Set-ups that change something, on real processes: policies over real sockets, a simulated bench that is reset."""

import json

import psutil
import pytest

from runtime.clients.client import Refused
from runtime.recording.reader import open_episode
from tests.crash.lab import Lab
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def bench(tmp_path_factory, shared):
    """A station with a tabletop, and beside the deployment's own policy server another one."""
    lab = Lab(tmp_path_factory.mktemp("bench"), shared.addresses).node("--bench", "tabletop")
    own = lab.addresses["server"]["url"]
    other = lab.start(
        *("other", "runtime.standins.serve", "openpi", "--robot", "agilex_piper", "--port", "0"),
        *("--latency-ms", "40"),
    )["url"]
    lab.up("transport.simulated=true", "transport.detect_frozen=false")
    lab.own, lab.other = own, other
    yield lab
    lab.close()


def connections(lab):
    """The policy servers that the coordinator is connected to, by port."""
    ports = {int(url.rpartition(":")[2].strip("/")) for url in (lab.own, lab.other)}
    found = psutil.Process(lab.pids()["coordinator"]).net_connections("tcp")
    return [one.raddr.port for one in found if one.raddr and one.raddr.port in ports]


def port(url):
    return int(url.rpartition(":")[2].strip("/"))


def set_up(lab, **arguments):
    ack = lab.client.command("setup", **arguments)
    status = lab.reach("ready", "idle", "faulted")
    assert status["state"] == "ready", status["reason"]
    return ack


def descriptors(lab):
    return psutil.Process(lab.pids()["coordinator"]).num_fds()


def test_policies_are_exchanged_over_real_sockets_and_never_two_are_connected(bench):
    set_up(bench)
    assert connections(bench) == [port(bench.own)]
    set_up(bench, policy={"url": bench.other}, checkpoint={"id": 2, "name": "B"})
    assert connections(bench) == [port(bench.other)]
    open_before = descriptors(bench)
    for url in (bench.own, bench.other) * 3:
        set_up(bench, policy={"url": url})
        assert connections(bench) == [port(url)]
    assert descriptors(bench) <= open_before + 1
    with pytest.raises(Refused, match=r"setup: policy\.url = 'nowhere': "):
        bench.client.command("setup", policy={"url": "nowhere"})
    assert connections(bench) == [port(bench.other)]
    run = bench.client.command("run", duration_s=1.0, trial={"id": 5}, operator="anna")
    bench.reach("ready")
    outcome = bench.outcome(run.data["episode"])
    manifest = json.loads((bench.data / "episodes" / run.data["episode"] / "manifest.json").read_text())
    assert outcome["status"] == "finished"
    assert manifest["configuration"]["policy"]["url"] == bench.other
    assert (manifest["trial"], manifest["operator"], manifest["duration_s"]) == ({"id": 5}, "anna", 1.0)


def test_a_policy_that_is_exchanged_while_it_is_asked_is_cut_off(bench):
    set_up(bench)
    bench.client.command("run")
    bench.client.wait(lambda s: s["policy"]["answers"] > 3, PATIENCE_S)
    bench.client.command("stop")  # with a request under way
    set_up(bench, policy={"url": bench.other})
    assert connections(bench) == [port(bench.other)]
    bench.client.command("run")
    status = bench.client.wait(lambda s: s["policy"]["answers"] > 3, PATIENCE_S)
    assert status["policy"]["latency_p50_ms"] > 35
    bench.client.command("stop")


def test_the_bench_is_reset_by_seed_and_the_episode_says_how_it_was_left(bench):
    where = {"block": [0.1, 0.3, 30.0], "plate": [-0.1, 0.3]}
    first = set_up(bench, bench={"seed": 4, "positions": where}).data["bench"]
    truth = bench.client.status()["truth"]
    assert (truth["reset"], truth["seed"], truth["success"]) == (first, 4, False)
    assert truth["blocks"][0][:2] == pytest.approx([0.1, 0.3], abs=0.03)
    again = set_up(bench, bench={"seed": 4, "positions": where}).data["bench"]
    assert again != first
    assert bench.client.status()["truth"]["blocks"] == truth["blocks"]
    episode = bench.client.command("run", duration_s=0.5).data["episode"]
    bench.reach("ready")
    bench.outcome(episode)
    recorded = open_episode(bench.data / "episodes" / episode)
    told = [event for event in recorded.events if event["kind"] == "truth"]
    assert [event["data"]["reset"] for event in told] == [again]
    assert told[0]["data"]["episode"] == episode


def test_places_that_the_bench_does_not_have_end_the_set_up_with_what_the_node_says(bench):
    with pytest.raises(Refused, match="block at x 9000, y 9000 mm; allowed on a simulated bench: "):
        bench.client.command("setup", bench={"seed": 4, "positions": {"block": [9.0, 9.0, 0.0]}})
    beyond_all_arms = {"plate": [0.0, 0.4]}  # in the area: only the node finds no place for the block
    bench.client.command("setup", bench={"seed": 4, "positions": beyond_all_arms})
    status = bench.reach("ready", "idle")
    assert status["state"] == "idle"
    assert status["reason"].startswith("the bench was not reset within 3 s: the robot refused it (")
    set_up(bench, bench={"seed": 4})


def test_a_node_that_is_not_declared_simulated_is_not_believed(lab):
    lab.node("--bench", "tabletop").up("transport.detect_frozen=false")
    status = eventually(lambda: _with_faults(lab), "the fault")
    assert status["link"]["faults"]["truth_ignored"] == 1
    assert (status["truth"], status["simulated"]) == ({}, False)
    with pytest.raises(Refused, match="the transport is not declared simulated"):
        lab.client.command("setup", bench={"seed": 1})
    lab.ready()


def _with_faults(lab):
    status = lab.client.status()
    return status if status["link"]["faults"] else None
