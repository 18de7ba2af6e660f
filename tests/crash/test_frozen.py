"""Cameras that freeze, and cameras that a deployment does without."""

import pytest

from runtime.recording.reader import open_episode
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow


def test_a_frozen_camera_makes_control_hold_and_is_named(lab):
    lab.node("--freeze-camera", "cam_high").up("setup.observation_timeout_s=1.0", "safety.picture_age_s=2.0")
    eventually(lambda: lab.events("source_frozen_cam_high"), "the event")
    ages = lab.client.wait(lambda s: s["link"]["ages"]["cam_high"] > 2.0, PATIENCE_S)["link"]["ages"]
    assert ages["cam_left_wrist"] < 0.5
    assert ages["joints"] < 0.5
    lab.client.command("setup")
    status = lab.reach("idle", "ready")
    assert status["state"] == "idle"
    assert "cam_high" in status["reason"]
    assert "s old (limit 2" in status["reason"]


def test_a_camera_that_may_stand_still_does_not(lab):
    lab.node("--freeze-camera", "cam_high").up("transport.detect_frozen=false").running(1.0)
    assert lab.client.status()["state"] == "running"
    assert lab.client.status()["link"]["ages"]["cam_high"] < 0.5


def test_a_run_without_a_disabled_camera_is_set_up_driven_and_recorded(lab):
    lab.node("--drop-camera", "cam_high").up('transport.disabled_cameras=["cam_high"]').running(1.0)
    assert lab.client.status()["state"] == "running"
    lab.client.command("stop")
    assert lab.outcome()["status"] == "finished"
    episode = open_episode(lab.episodes()[0])
    assert sorted(episode.videos) == ["cam_left_wrist", "cam_right_wrist"]
    assert episode.frames > 15
