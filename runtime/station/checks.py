"""Checks that the parts of a deployment fit each other, run once at the start of a station or preflight."""

from __future__ import annotations

from runtime.config import collection
from runtime.config.loader import Resolved
from runtime.core.errors import ConfigurationError, SetupError
from runtime.core.plugins import variants
from runtime.core.pose_format import reject_pose_format
from runtime.station.spec import StationSpec, build_spec


def check_deployment(resolved: Resolved) -> StationSpec:
    """Check that the parts of a deployment fit each other. Raises ConfigurationError or SetupError."""
    settings, made = resolved.deployment, build_spec(resolved)
    robot = made.robot
    if settings.setup.pose not in robot.poses:
        raise ConfigurationError(
            f"setup.pose = {settings.setup.pose!r}: {robot.name} has {', '.join(sorted(robot.poses))}"
        )
    unknown = set(settings.safety.workspace) - {arm.name for arm in robot.arms}
    if unknown:
        arms = ", ".join(arm.name for arm in robot.arms)
        raise ConfigurationError(f"safety.workspace.{min(unknown)}: {robot.name} has the arms {arms}")
    if made.fps > made.rate:
        raise ConfigurationError(
            f"recording.fps = {made.fps:g}: there would be more rows than ticks; "
            f"allowed: at most {made.rate:g}, the control rate"
        )
    strange = [camera for camera in settings.recording.heights if camera not in made.cameras]
    if strange:
        raise ConfigurationError(
            f"recording.heights: {', '.join(strange)} are no cameras of this station; "
            f"allowed: {', '.join(made.cameras)}"
        )
    if settings.cameras:
        from runtime.cameras.attach import check

        check(settings.cameras, robot)
    collection.check(settings.collection, made.cameras)
    _check_publication(made)
    _check_collection(made)
    if settings.safety.report_only and made.capabilities.moves_robot:
        raise SetupError(
            f"safety.report_only = true with transport {settings.transport.kind!r}: it can move a robot; "
            "report-only is for transports that cannot (dataset)"
        )
    return made


def _check_collection(made: StationSpec) -> None:
    """Check that a node which drives by itself can be started and stopped by us, and reports its actions."""
    wanted, capabilities = made.deployment.collection, made.capabilities
    if wanted is not None and wanted.source == "node" and not capabilities.drives_itself:
        kind = made.deployment.transport.kind
        leads = kind if kind in variants("runtime.teleoperators") else "zmq"
        raise SetupError(
            f'collection.source = "node" with transport {kind!r}, which can neither switch a robot\'s own leader on '
            "and off, as every stop has to, nor report what the robot applied; allowed: "
            f'the transport zmq, or source = "relay" with collection.leader.kind = {leads!r}'
        )


def _check_publication(made: StationSpec) -> None:
    """Check that the transport can publish the configured space and pose format."""
    wanted, capabilities = made.deployment.publication, made.capabilities
    kind = made.deployment.transport.kind
    if wanted.space not in capabilities.spaces:
        raise SetupError(
            f"publication.space = {wanted.space!r} with transport {kind!r}, which has no such command; "
            f"allowed: {', '.join(sorted(capabilities.spaces))}"
        )
    if wanted.space == "joint":
        reject_pose_format(wanted.pose, "publication.pose")
        return
    from runtime.spaces.pose_rows import PoseRows

    PoseRows(wanted.pose, made.robot, "publication.pose")
    if capabilities.poses and wanted.pose not in capabilities.poses:
        raise SetupError(
            f"publication.pose = {wanted.pose} with transport {kind!r}; "
            f"allowed: {'; '.join(map(str, capabilities.poses))}"
        )
