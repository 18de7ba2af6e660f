"""What of the environment reaches a station, its children and ssh."""

import os
import runpy
import subprocess
import sys

import pytest

from runtime.core import environment
from runtime.core.environment import (
    WEB_ONLY,
    program_environment,
    read_secret,
    ssh_environment,
    without_web_secrets,
)
from runtime.core.errors import ConfigurationError, RuntimeFault
from runtime.policies.tunnel.ssh_process import Ssh
from runtime.preflight.__main__ import _asked_for
from runtime.station import preflight_child as child
from tests.processes import PATIENCE_S, eventually

SHED = (
    "import os; from runtime.core import environment; before = os.getpid(); environment.restart_without_web_secrets(); "
    "print(open('/proc/self/environ').read().replace(chr(0), ' '), os.environ.get('KEPT'))"
)


def test_a_program_that_was_started_with_secrets_goes_on_without_as_the_same_process():
    given = os.environ | dict.fromkeys((*WEB_ONLY, "EVA_JUDGE_MINE"), "canary") | {"KEPT": "this"}
    started = subprocess.Popen([sys.executable, "-c", SHED], env=given, stdout=subprocess.PIPE, text=True)
    said, _ = started.communicate(timeout=PATIENCE_S)
    assert started.returncode == 0
    assert "canary" not in said
    assert said.endswith(" this\n")


@pytest.mark.parametrize("module", ["runtime", "runtime.preflight", "runtime.standins.lockstep"])
def test_every_way_to_start_a_station_sheds_them_first(module, monkeypatch):
    class Gone(Exception):
        pass

    def execve(program, arguments, kept):
        assert (program, "EVA_SECRET_KEY" in kept, "PATH" in kept) == (sys.executable, False, True)
        raise Gone

    monkeypatch.setenv("EVA_SECRET_KEY", "canary")
    monkeypatch.setattr(os, "execve", execve)
    monkeypatch.delitem(sys.modules, f"{module}.__main__", raising=False)
    with pytest.raises(Gone):
        runpy.run_module(module, run_name="__main__", alter_sys=False)


def test_who_has_none_is_not_started_again(monkeypatch):
    for name in WEB_ONLY:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "execve", lambda *given: pytest.fail("it was"))
    environment.restart_without_web_secrets()


def test_the_process_of_a_preflight_has_none(monkeypatch):
    monkeypatch.setenv("DATABASE_URL", "canary")
    monkeypatch.setenv("EVA_POLICY_KEY", "the policy's")
    told = []
    monkeypatch.setattr(child.subprocess, "Popen", lambda line, env, **how: told.append(env))
    child._spawn_child()
    assert ("DATABASE_URL" in told[0], told[0]["EVA_POLICY_KEY"]) == (False, "the policy's")


def test_a_preflight_by_the_file_of_a_station_names_what_that_lists_alone(tmp_path):
    file = tmp_path / "bench.toml"
    file.write_text(
        'station = "b"\nrobot = "r"\n[transport]\nkind = "zmq"\n[policy]\nkind = "openpi"\n', "utf-8"
    )
    asked = {"deployment": str(file), "changes": {"policy": {"api_key_env": "EVA_SECRET_KEY"}}}
    with pytest.raises(RuntimeFault, match=r"security\.variables"):
        _asked_for(asked)
    assert (
        _asked_for(asked | {"changes": {"policy": {"api_key_env": "EVA_POLICY_A"}}}).deployment.station == "b"
    )


def test_ssh_gets_what_it_needs_and_no_key_of_anybody(monkeypatch):
    monkeypatch.setenv("EVA_POLICY_KEY", "canary")
    monkeypatch.setenv("SSH_AUTH_SOCK", "/run/agent")
    monkeypatch.setenv("LC_ALL", "C")
    has = ssh_environment()
    assert {"HOME", "PATH", "SSH_AUTH_SOCK", "LC_ALL"} <= set(has)
    line = [
        sys.executable,
        "-c",
        "import os; print('canary' in str(os.environ), os.environ['SSH_AUTH_SOCK'])",
    ]
    ssh = Ssh(line, 1)
    try:
        eventually(lambda: ssh.poll() is not None, "its end", 3 * PATIENCE_S)
        assert list(ssh.said) == ["False /run/agent"]
    finally:
        ssh.terminate()


@pytest.mark.parametrize("name", sorted((*WEB_ONLY, "EVA_JUDGE_MINE")))
def test_what_is_the_webs_is_no_key_of_a_policy_even_where_the_deployment_says_so(name, monkeypatch):
    monkeypatch.setenv(name, "canary")
    with pytest.raises(ConfigurationError, match=f"names {name}, which is the web's") as caught:
        read_secret("policy.api_key_env", name)
    assert "canary" not in str(caught.value)


def test_a_key_that_is_not_there_is_named_with_its_variable(monkeypatch):
    monkeypatch.setenv("EVA_POLICY_KEY", "value")
    assert read_secret("policy.api_key_env", "EVA_POLICY_KEY") == "value"
    with pytest.raises(ConfigurationError, match="password_env names ABSENT, which is not set"):
        read_secret("password_env", "ABSENT")


def test_all_else_is_kept():
    assert without_web_secrets({"REDIS_URL": "x", "ROS_DOMAIN_ID": "7"}) == {"ROS_DOMAIN_ID": "7"}


@pytest.mark.parametrize("given", ["OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS"])
def test_the_number_of_threads_that_an_administrator_names_stays(given: str) -> None:
    plug_ins = {"PYDANTIC_DISABLE_PLUGINS": "__all__"}
    assert program_environment({given: "3"}) == {given: "3"} | plug_ins
    assert program_environment({"HOME": "/"}) == {"HOME": "/", "OPENBLAS_NUM_THREADS": "1"} | plug_ins
    assert program_environment({"PYDANTIC_DISABLE_PLUGINS": "mine"})["PYDANTIC_DISABLE_PLUGINS"] == "mine"
