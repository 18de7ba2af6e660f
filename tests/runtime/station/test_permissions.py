"""Who may bring tables to a station, and what of the station's own they may name."""

import os

import pytest

from runtime.config.loader import resolve_deployment
from runtime.core.errors import RuntimeFault
from runtime.core.host_references import HostReference, find_host_references
from runtime.core.plugins import variants
from runtime.core.settings import Settings
from runtime.ipc.messages import Command
from runtime.station import permissions as rights

GR00T = {"kind": "gr00t", "video": {"cam": "c"}, "state": {"q": [0]}, "actions": {"q": [0]}}
KEY = "EVA_SECRET_KEY"


@pytest.fixture
def own(tmp_path):
    def own(**tables):
        tree = {
            "station": "bench",
            "robot": "r",
            "data_dir": str(tmp_path / "data"),
            "transport": {"kind": "zmq"},
            "policy": {"kind": "openpi"},
            **tables,
        }
        return resolve_deployment(tree, {}, "test")

    return own


def given(role, kind="setup", vouched=(), **args):
    return Command("u", kind, args, user="ann", role=role, vouched=list(vouched))


def refusal(command, own):
    with pytest.raises(RuntimeFault) as caught:
        rights.require(command, own)
    return str(caught.value)


@pytest.mark.parametrize("kind", ["setup", "preflight", "policy_server"])
@pytest.mark.parametrize("key", ["policy", "checkpoint"])
@pytest.mark.parametrize("role", ["viewer", "operator", "nonsense"])
def test_no_table_is_taken_from_who_is_no_administrator(own, kind, key, role):
    said = refusal(given(role, kind, **{key: {}}), own())
    assert f"{kind}: {key} by ann, whose role is {role}: tables are for administrators" in said


def test_what_an_administrator_wrote_an_operator_may_bring(own):
    rights.require(given("operator", vouched=["policy"], policy={"url": "ws://127.0.0.1:1"}), own())


@pytest.mark.parametrize("kind", ["stop", "halt", "estop", "run", "tune", "move", "jog"])
def test_commands_without_tables_are_never_looked_at(own, kind):
    rights.require(given("viewer", kind, policy={"api_key_env": KEY}), own())


NAMING = [
    {"api_key_env": KEY},
    {"kind": "roboarena", "api_key_env": KEY},
    {"kind": "starvla", "api_key_env": KEY},
    {"kind": "xpolicylab", "api_key_env": KEY},
    GR00T | {"api_token_env": KEY},
    {"tunnel": {"host": "h", "identity_file": "/etc/passwd"}},
    {"tunnel": {"host": "h", "ssh_config": "~/.ssh/config"}},
    {"tunnel": {"host": "h", "known_hosts_file": "~/.ssh/authorized_keys"}},
    {"kind": "replay", "path": "/etc"},
    {"kind": "replay", "path": "relative"},
    {"kind": "replay", "path": "nul\x00"},
]


@pytest.mark.parametrize("table", NAMING, ids=str)
def test_not_even_an_administrators_table_names_what_is_not_listed(own, table):
    command = given("admin", policy=table)
    said = refusal(command, own())
    assert "a table from the web may" in said
    for role in rights.OWN_ACCOUNT:
        rights.require(given(role, policy=table), own())


@pytest.mark.parametrize("table", NAMING[:-2], ids=str)
def test_the_deployment_lists_what_may_be_named(own, table):
    kept = own(security={"variables": [KEY], "files": ["/etc", "~/.ssh"]})
    if "known_hosts_file" in table.get("tunnel", {}):  # it is written: listing is not enough
        assert "written below" in refusal(given("admin", policy=table), kept)
    else:
        rights.require(given("admin", policy=table), kept)


def test_what_its_own_policy_names_stays_allowed(own):
    kept = own(
        policy={"kind": "openpi", "api_key_env": "OURS", "tunnel": {"host": "h", "identity_file": "/k"}}
    )
    rights.require(given("admin", policy={"url": "ws://127.0.0.1:2"}), kept)
    rights.require(given("admin", policy=GR00T | {"api_token_env": "OURS"}), kept)


def test_a_table_that_fits_no_policy_is_refused_by_who_carries_it_out(own):
    rights.require(given("admin", policy={"kind": "gr00t", "api_token_env": KEY}), own())
    rights.require(given("admin", policy={"kind": "nonsense"}), own())


def test_a_variable_of_the_usual_names_needs_no_list(own):
    rights.require(given("admin", policy={"api_key_env": "EVA_POLICY_GPU"}), own())
    assert "EVA_POLICY_*" in refusal(given("admin", policy={"api_key_env": "XEVA_POLICY_GPU"}), own())


@pytest.mark.parametrize("wrong", ["*", "A-B", "", "A*B"])
def test_a_list_of_everything_is_no_list(own, wrong):
    with pytest.raises(RuntimeFault, match=r"security\.variables"):
        own(security={"variables": [wrong]})


def dataset(folder):
    """What tells a folder as a dataset."""
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text("{}")


def test_of_the_data_folder_recordings_and_datasets_alone_may_be_named(own):
    kept = own()
    data = kept.deployment.data
    dataset(data / "mine" / "cups")
    (data / "episodes" / "one").mkdir(parents=True)
    (data / "episodes" / "one" / "manifest.json").write_text("{}")
    (data / "scores").mkdir()
    for name in ("mine/cups", "episodes/one"):
        rights.require(given("admin", policy={"kind": "replay", "path": f"{data}/{name}"}), kept)
    for name in ("", "scores", "mine", "episodes/one/manifest.json", "eva.sqlite3", "mine/none"):
        said = refusal(given("admin", policy={"kind": "replay", "path": f"{data}/{name}"}), kept)
        assert "may name the folder of a recording or of a dataset below" in said


def test_neither_links_nor_dots_lead_out_of_a_folder(own, tmp_path):
    kept = own()
    ssh, recordings = kept.deployment.ssh_dir, kept.deployment.data / "datasets"
    ssh.mkdir(parents=True)
    dataset(recordings / "cups")
    (ssh / "out").symlink_to("/etc/passwd")
    (recordings / "out").symlink_to("/etc")
    (ssh / "round").symlink_to(ssh / "round")
    for name in ("out", "../latch.json", "round/x"):
        for key in ("known_hosts_file", "identity_file"):
            refusal(given("admin", policy={"tunnel": {"host": "h", key: f"{ssh}/{name}"}}), kept)
    refusal(given("admin", policy={"kind": "replay", "path": f"{recordings}/out"}), kept)
    rights.require(given("admin", policy={"tunnel": {"host": "h", "known_hosts_file": f"{ssh}/known"}}), kept)
    rights.require(given("admin", policy={"kind": "replay", "path": f"{recordings}/cups"}), kept)


def test_datasets_on_another_disk_are_the_labs_own(own, tmp_path):
    kept = own()
    kept.deployment.data.mkdir()
    dataset(tmp_path / "disk" / "cups")
    (kept.deployment.data / "datasets").symlink_to(tmp_path / "disk")
    path = f"{kept.deployment.data}/datasets/cups"
    rights.require(given("operator", vouched=["policy"], policy={"kind": "replay", "path": path}), kept)


def keys(table: type[Settings], prefix=""):
    """Every key of a kind of policy with its annotation and metadata in words."""
    for name, field in table.model_fields.items():
        yield prefix + name, f"{field.annotation} {field.metadata}"
    tunnel = table.model_fields.get("tunnel")
    if tunnel is not None and not prefix:
        from runtime.policies.tunnel.settings import TunnelSettings

        yield from keys(TunnelSettings, "tunnel.")


@pytest.mark.parametrize("kind", sorted(variants("runtime.policies")))
def test_every_key_that_sounds_like_a_file_or_a_variable_is_marked_as_one(kind):
    for key, words in keys(variants("runtime.policies")[kind].Config):
        sounds = key.endswith(("_env", "_file", "_config", "_dir")) or key == "path"
        assert ("HostReference." in words) == sounds, key


def test_values_that_name_something_are_found_in_tables_within_tables(own):
    table = {"host": "h", "identity_file": "/k", "known_hosts_file": "/w"}
    policy = own(policy={"kind": "openpi", "api_key_env": "OURS", "tunnel": table}).deployment.policy
    assert set(find_host_references(policy)) == {
        ("api_key_env", HostReference.VARIABLE, "OURS"),
        ("tunnel.identity_file", HostReference.FILE, "/k"),
        ("tunnel.known_hosts_file", HostReference.WRITTEN, "/w"),
    }


def test_home_is_the_accounts(own, monkeypatch):
    kept = own()
    monkeypatch.setenv("HOME", str(kept.deployment.ssh_dir))
    assert os.path.expanduser("~/key").startswith(str(kept.deployment.ssh_dir))
    rights.require(given("admin", policy={"tunnel": {"host": "h", "identity_file": "~/key"}}), kept)
