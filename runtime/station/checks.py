"""Checks that the parts of a deployment fit each other, run once at the start of a station or preflight."""

from __future__ import annotations

from runtime.benches.schema import load_schema
from runtime.config import collection
from runtime.config.loader import Resolved
from runtime.core.errors import ConfigurationError, SetupError
from runtime.core.plugins import variants
from runtime.core.pose_format import reject_pose_format
from runtime.station.spec import StationSpec, build_spec


def check_deployment(resolved: Resolved) -> StationSpec:
    """Check that the parts of a deployment fit each other. Raises ConfigurationError or SetupError."""
    settings, spec = resolved.deployment, build_spec(resolved)
    robot = spec.robot
    if settings.setup.pose not in robot.poses:
        raise ConfigurationError(
            f"setup.pose = {settings.setup.pose!r}: {robot.name} has {', '.join(sorted(robot.poses))}"
        )
    unknown = set(settings.safety.workspace) - {arm.name for arm in robot.arms}
    if unknown:
        arms = ", ".join(arm.name for arm in robot.arms)
        raise ConfigurationError(f"safety.workspace.{min(unknown)}: {robot.name} has the arms {arms}")
    if spec.fps > spec.rate:
        raise ConfigurationError(
            f"recording.fps = {spec.fps:g}: there would be more rows than ticks; "
            f"allowed: at most {spec.rate:g}, the control rate"
        )
    strange = [camera for camera in settings.recording.heights if camera not in spec.cameras]
    if strange:
        raise ConfigurationError(
            f"recording.heights: {', '.join(strange)} are no cameras of this station; "
            f"allowed: {', '.join(spec.cameras)}"
        )
    if spec.capabilities.bench:
        load_schema(spec.capabilities.bench)
    if settings.cameras:
        from runtime.cameras.attach import check

        check(settings.cameras, robot)
    collection.check(settings.collection, spec.cameras)
    _check_publication(spec)
    _check_collection(spec)
    if settings.lockstep.benchmark:
        _check_benchmark(spec)
    elif settings.safety.report_only and spec.capabilities.moves_robot:
        raise SetupError(
            f"safety.report_only = true with transport {settings.transport.kind!r}: it can move a robot; "
            "report-only is for transports that cannot (dataset), and for lockstep.benchmark"
        )
    return spec


def _check_benchmark(spec: StationSpec) -> None:
    """Check that the robot's numbers reach the bench of a benchmark as they are."""
    robot, dims = spec.robot, spec.dims
    for kind, changed in (
        ("binary grippers", dims.switched),
        ("joints that turn without end", dims.wrapping),
    ):
        if changed:
            names = ", ".join(robot.joint_names[dim] for dim in changed)
            raise SetupError(
                f"lockstep.benchmark = true: {names} of {robot.name} are {kind}, whose numbers are changed on the way "
                "to the bench; allowed: none (grippers.NAME.binary = false), or lockstep.benchmark = false"
            )


def _check_collection(spec: StationSpec) -> None:
    """Check that a node which drives by itself can be started and stopped by us, and reports its actions."""
    collection_settings, capabilities = spec.deployment.collection, spec.capabilities
    if (
        collection_settings is not None
        and collection_settings.source == "node"
        and not capabilities.drives_itself
    ):
        kind = spec.deployment.transport.kind
        leads = kind if kind in variants("runtime.teleoperators") else "zmq"
        raise SetupError(
            f'collection.source = "node" with transport {kind!r}, which can neither switch a robot\'s own leader on '
            "and off, as every stop has to, nor report what the robot applied; allowed: "
            f'the transport zmq, or source = "relay" with collection.leader.kind = {leads!r}'
        )


def _check_publication(spec: StationSpec) -> None:
    """Check that the transport can publish the configured space and pose format."""
    publication, capabilities = spec.deployment.publication, spec.capabilities
    kind = spec.deployment.transport.kind
    if publication.space not in capabilities.spaces:
        raise SetupError(
            f"publication.space = {publication.space!r} with transport {kind!r}, which has no such command; "
            f"allowed: {', '.join(sorted(capabilities.spaces))}"
        )
    if publication.space == "joint":
        reject_pose_format(publication.pose, "publication.pose")
        return
    from runtime.spaces.pose_rows import PoseRows

    PoseRows(publication.pose, spec.robot, "publication.pose")
    if capabilities.poses and publication.pose not in capabilities.poses:
        raise SetupError(
            f"publication.pose = {publication.pose} with transport {kind!r}; "
            f"allowed: {'; '.join(map(str, capabilities.poses))}"
        )
