"""Policy behind a tunnel: another policy that connects to the tunnel's local port."""

from __future__ import annotations

import contextlib
import shutil
import threading
from collections.abc import Iterator

from runtime.core.errors import (
    ConfigurationError,
    PolicyError,
    PolicyLostError,
    PortClosedError,
    TunnelError,
    UnreachableError,
)
from runtime.core.settings import Settings
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.policies.base import Policy, PolicyInfo
from runtime.policies.connection import Place
from runtime.policies.tunnel.command import command, far_end, require_files
from runtime.policies.tunnel.keeper import Status, TunnelKeeper
from runtime.policies.tunnel.settings import TunnelSettings
from runtime.policies.tunnel.ssh_messages import explain_forward_refused
from runtime.policies.tunnel.ssh_process import Ssh, free_port

_SLACK_S = 3.0  # beyond the keeper's own deadline, whose message is better [s]
_HEARD_S = 0.3  # time until ssh's end or its messages are known [s]


def through_tunnel(policy: Policy, config: Settings) -> Policy:
    """Return `policy` behind the tunnel of its configuration, or `policy` itself if that has none.

    Starts nothing. Raises ConfigurationError if ssh is not installed, or policy.url cannot be reached through a tunnel.
    """
    settings, url = getattr(config, "tunnel", None), getattr(config, "url", "")
    if settings is None:
        return policy
    far, ssh = far_end(url), shutil.which("ssh")
    if ssh is None:
        raise ConfigurationError(
            "policy.tunnel needs the program ssh, which is not installed (on Debian: apt-get install openssh-client)"
        )
    return TunnelledPolicy(policy, settings, far, ssh)


class TunnelledPolicy(Policy):
    """Policy whose tunnel is opened by `connect` and lives until `close`; while it is down, errors name the reason.

    Each ssh has a new local port, so that stations and other programs cannot conflict.
    """

    def __init__(self, policy: Policy, settings: TunnelSettings, far: Place, ssh: str) -> None:
        self._policy = policy
        self._settings = settings
        self._far = far
        self._ssh = ssh
        self._turning = threading.Lock()  # for the change of keepers; held briefly
        self._keeper: TunnelKeeper | None = None
        self.observation_eef, self.uses_poses = policy.observation_eef, policy.uses_poses
        self.uses_images, self.is_queried = policy.uses_images, policy.is_queried
        self.is_person = policy.is_person
        self.observe_period_s = policy.observe_period_s
        policy.address_override = self._local_address

    def connect(self) -> PolicyInfo:
        """Open the tunnel, then connect to the server; an existing tunnel is replaced."""
        require_files(self._settings)
        keeper = self._new_keeper()
        status = keeper.wait_for(
            lambda now: now.up or now.closed or now.failures > 0, self._settings.connect_deadline + _SLACK_S
        )
        if not status.up:
            keeper.close()  # otherwise it would try on although no thread waits for it
            raise self._ended(status) if status.closed else TunnelError(self._absence(status))
        with self._explain_errors():
            return self._policy.connect()

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Call the policy's `infer`. Raises PolicyLostError with the tunnel's reason while it is down."""
        if self._keeper is None:
            raise self._never()
        with self._explain_errors():
            return self._policy.infer(observation, conditioning)

    def observe(self, observation: Observation) -> None:
        """Call the policy's `observe`."""
        self._policy.observe(observation)

    def reset(self) -> None:
        """Call the policy's `reset`."""
        with self._explain_errors():
            self._policy.reset()

    def resume(self) -> None:
        """Call the policy's `resume`."""
        self._policy.resume()

    def end_episode(self) -> None:
        """Call the policy's `end_episode`."""
        with self._explain_errors():
            self._policy.end_episode()

    def close(self) -> None:
        """Close the policy and the tunnel."""
        with self._turning:
            if self._keeper is not None:
                self._keeper.close()
            self._policy.close()

    def _new_keeper(self) -> TunnelKeeper:
        with self._turning:
            if self._keeper is not None:
                self._keeper.close()
            self._keeper = TunnelKeeper(self._settings.where, self._start, self._settings.connect_deadline)
            self._keeper.start()
            return self._keeper

    def _start(self) -> Ssh:
        port = free_port()
        return Ssh(command(self._ssh, self._settings, port, self._far), port, self._settings.session)

    def _local_address(self) -> Place:
        """Return host and port of the tunnel's local end. Raises TunnelError while the tunnel is down.

        Each call checks that the present ssh owns the port: after ssh has ended, another process may take it.
        """
        keeper = self._keeper
        if keeper is None:
            raise self._never()
        status = keeper.status
        if status.up and not keeper.owns_port(status.port):
            status = keeper.wait_for(lambda now: not now.up, _HEARD_S)
        if status.closed:
            raise self._ended(status)
        if not status.up or not keeper.owns_port(status.port):
            raise TunnelError(self._down(keeper, status))
        return "127.0.0.1", status.port

    @contextlib.contextmanager
    def _explain_errors(self) -> Iterator[None]:
        """Replace errors in this context that the tunnel caused by errors that explain its state."""
        keeper = self._keeper
        before = keeper.status if keeper else None
        try:
            yield
        except TunnelError:
            raise
        except PolicyError as error:
            lost = isinstance(error, PolicyLostError) or isinstance(error.__cause__, OSError)
            if keeper is None or before is None or not lost:
                raise
            status = keeper.wait_for(lambda now: not now.up or _changed(before, now), _HEARD_S)
            if status.closed:
                raise
            if not status.up:
                raise TunnelError(self._down(keeper, status)) from error
            if status.failures > before.failures:
                where = self._settings.where
                raise TunnelError(f"the tunnel to {where} broke and is up again: {status.why}") from error
            if status.refusals > before.refusals:
                closed = "Connection refused" in status.refusal
                raise (PortClosedError if closed else UnreachableError)(self._unreached(status)) from error
            raise type(error)(f"{error} (through the tunnel to {self._settings.where})") from error

    def _never(self) -> PolicyError:
        return PolicyError(f"there is no tunnel to {self._settings.where}; connect first")

    def _ended(self, status: Status) -> PolicyError:
        return PolicyError(f"{self._absence(status)}; connect first")

    def _absence(self, status: Status) -> str:
        return f"there is no tunnel to {self._settings.where}: {status.why}"

    def _down(self, keeper: TunnelKeeper, status: Status) -> str:
        return f"the tunnel to {self._settings.where} is down since {keeper.duration(status):.0f} s: {status.why}"

    def _unreached(self, status: Status) -> str:
        host, port = self._far
        return (
            f"the tunnel to {self._settings.where} is up, but {host} port {port} was not reached from there "
            f"({status.refusal}): {explain_forward_refused(status.refusal)}"
        )


def _changed(before: Status, now: Status) -> bool:
    return now.failures > before.failures or now.refusals > before.refusals
