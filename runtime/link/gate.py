"""Lab's end of the link, which makes linked stations appear as local ones to the programs of this computer.

One thread relays stops and commands: first the stops of all stations, then a few messages of each. It never waits for a
database or a station.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zmq
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from runtime.core.errors import TransportError
from runtime.ipc.bus import CommandServer, IncomingMessage
from runtime.ipc.fair_queue import QueuedCommand
from runtime.ipc.messages import Ack, Command, encode
from runtime.link.admission import Admission, AllowList, Seldom
from runtime.link.door import Arrival, Door
from runtime.link.enrolling import Enroller, Enrolling
from runtime.link.incoming import Incoming
from runtime.link.key_files import KeyPair
from runtime.link.lab_streams import LabStreams
from runtime.link.mirror import STOPPING, Mirror, MirrorLockedError
from runtime.link.release import version
from runtime.link.remote import Line, Pending, PendingPress, Remote
from runtime.link.tokens import Signer
from runtime.link.wire import (
    COMMANDS,
    COORDINATOR,
    GUARD,
    LARGEST_ANSWER,
    MEDIA,
    RELEASE,
    STOPS,
    Answer,
    Ask,
    Beat,
    Enrol,
    Enrolled,
    Hello,
    Welcome,
    apart,
)

log = logging.getLogger(__name__)
RATE = 8e6  # greatest rate of one connection [bytes/s]
_POLL_MS = 50
_LOOK_S = 0.05
_TRY_S = 2.0  # between two tries to lock the folder of a station
_MOST_PENDING = 64  # pending commands per station
_PENDING_S = 30.0  # [s] after which the sender of a pending command is answered in the station's place
_HOPE_S = 0.8  # [s] that a press waits for a link just lost before its sender is answered
_HELD_S = 5.0  # [s] after which a press that could not be sent is dropped
_MOST_HELD = 64  # held presses per station
_LOST = "the link to its computer is lost: it continues by its own rules"
_NOT_RUNNING = "its computer is linked, and the station does not run there: start it"


class Gate:
    """Lab's end of the link, with the port for stops and commands; `LabStreams` has the other port.

    One thread uses it and calls `turn`; only `linked` may be called from any thread.
    """

    def __init__(
        self,
        data: Path,
        key: KeyPair,
        tokens: bytes,
        allowed: AllowList,
        enrol: Enroller,
        where: tuple[str, int, int],
        clock: Callable[[], float] = time.monotonic,
        incoming: Incoming | None = None,
    ) -> None:
        """Listen at both ports.

        Args:
            data: Data folder of the lab.
            key: CURVE key pair of the lab.
            tokens: Ed25519 secret with which commands are signed.
            allowed: Keys that may connect.
            enrol: Checks a code for enrolment.
            where: Address to listen at, and its two ports; 0 chooses a free port.
            incoming: Receiver of episodes; None: the lab accepts no episodes of stations elsewhere.

        Raises:
            TransportError: A port cannot be opened.
        """
        host, port, second_port = where
        self._stations = data / "stations"
        self._allowed, self._clock = allowed, clock
        self._signer = Signer(Ed25519PrivateKey.from_private_bytes(tokens))
        self._remotes: dict[str, Remote] = {}
        self._by_route: dict[bytes, tuple[str, str]] = {}  # station and role
        self._number = 0
        self._seldom = Seldom(clock)
        self._looked = -float("inf")
        self._context: zmq.Context[Any] = zmq.Context()
        self._enrolling = Enrolling(enrol, clock)
        self._streams = LabStreams(host, second_port, key, allowed, clock, incoming)
        self._admission = Admission([self._context, self._streams.context], allowed, clock)
        self._admission.start()
        self._door = Door(self._context, host, port, key, LARGEST_ANSWER, RATE, allowed, clock)
        self.port, self.second_port = self._door.port, self._streams.open()
        self._streams.start()

    def turn(self, wait_ms: int = _POLL_MS) -> None:
        """Wait for messages and pass them on, stops first.

        Raises: TransportError if the streams' thread has failed.
        """
        self._wait(wait_ms)
        if self._streams.failed:
            raise TransportError("streams of stations elsewhere have ended: see the log above")
        for remote in self._remotes.values():
            self._press(remote)
        names = {self._handle_safely(arrival) for arrival in self._door.arrivals()}
        for remote in [
            self._remotes[name] for name in names if name
        ]:  # after all messages of this turn, so that each station is adjusted once
            self._adjust(remote)
        for remote in self._remotes.values():
            self._command(remote)
        for route, answer in self._enrolling.answers():
            self._enrolled(route, answer)
        self._lose(self._door.gone)
        if (now := self._clock()) - self._looked >= _LOOK_S:
            self._looked = now
            self._poll(now)

    def close(self) -> None:
        """Close the mirrors of all stations and both ports."""
        for remote in self._remotes.values():
            self._close(remote, "the lab's gate was ended")
        self._enrolling.end()
        self._streams.end()
        self._door.close()
        self._admission.end()
        self._context.destroy(linger=0)
        self._streams.context.destroy(linger=0)

    def linked(self) -> set[str]:
        """Return the stations that can be commanded now; any thread may call it."""
        return {remote.name for remote in list(self._remotes.values()) if remote.up}

    def _wait(self, wait_ms: int) -> None:
        poller = zmq.Poller()
        poller.register(self._door.socket, zmq.POLLIN)
        for remote in self._remotes.values():
            if remote.mirror is None:
                continue
            if remote.mirror.waiting:
                wait_ms = 0
            poller.register(remote.mirror.estops.socket, zmq.POLLIN)
            if remote.mirror.commands is not None:
                poller.register(remote.mirror.commands.socket, zmq.POLLIN)
        poller.poll(wait_ms)

    # --- from the lab's programs --------------------------------------------------------------------------------

    def _press(self, remote: Remote) -> None:
        """Pass on all messages of the e-stop socket; hold presses while there is no connection to the station."""
        if (mirror := remote.mirror) is None:
            return
        presses, commands = mirror.estop_turns.take_turn()
        for call, command in presses:
            payload, verified = _payload(mirror, call, command)
            pending = PendingPress(call, command, payload, verified, self._clock())
            if not self._pass_press(remote, pending):
                self._hold_press(remote, pending)
        for call, command in commands:
            self._pass_command(remote, (call, command), (GUARD, "estop"), mirror.estops)

    def _command(self, remote: Remote) -> None:
        """Pass on all stops of the command socket, and a bounded share of its other messages."""
        if remote.mirror is None or remote.mirror.command_turns is None or remote.mirror.commands is None:
            return
        server = remote.mirror.commands
        urgent, commands = remote.mirror.command_turns.take_turn()
        for queued in (*urgent, *commands):
            self._pass_command(remote, queued, (COORDINATOR, "commands"), server)

    def _pass_press(self, remote: Remote, press: PendingPress) -> bool:
        """Send a press over the station's connection for stops, or over that for commands if the former is silent.

        Return False if neither is alive or the press cannot be sent.
        """
        now = self._clock()
        line = remote.line(STOPS, now) or remote.line(COMMANDS, now)
        if line is None or remote.mirror is None:
            return False
        token = press.payload, press.verified
        number = self._send(remote, line, (GUARD, "estop"), token, stops=True)
        if number and not press.told:
            server, until = remote.mirror.estops, now + _PENDING_S
            remote.pending[number] = Pending(server, press.call, press.command, until, press)
        return bool(number)

    def _pass_command(
        self, remote: Remote, queued: QueuedCommand, place: tuple[str, str], server: CommandServer
    ) -> None:
        assert remote.mirror is not None
        (call, command), now = queued, self._clock()
        stops = command.kind in STOPPING
        payload, verified = _payload(remote.mirror, call, command)
        line = (remote.line(STOPS, now) if stops or place[0] == GUARD else None) or remote.line(COMMANDS, now)
        if not verified and not stops:
            server.answer(call, Ack(command.uuid, "refused", _unsigned(command)))
        elif line is None:
            server.answer(call, _not_sent(remote, command))
        elif not stops and len(remote.pending) >= _MOST_PENDING:
            reason = (
                f"{_MOST_PENDING} commands wait for {remote.name} already: wait for answers; stops are obeyed"
            )
            server.answer(call, Ack(command.uuid, "refused", reason))
        elif number := self._send(remote, line, place, (payload, verified), stops):
            remote.pending[number] = Pending(server, call, command, now + _PENDING_S)
        else:
            server.answer(call, _not_sent(remote, command))

    def _send(
        self, remote: Remote, line: Line, place: tuple[str, str], signed: tuple[bytes, bool], stops: bool
    ) -> int:
        """Send a command, with a token if its user is verified.

        Args:
            remote: Station that gets the command.
            line: Connection to use.
            place: Process and name of the socket that the command is for.
            signed: Payload, and whether its user is verified because the web has signed it.
            stops: Whether the command is a stop.

        Returns:
            Number of the request; 0 if it could not be sent.
        """
        self._number += 1
        payload, verified = signed
        ask = Ask(self._number, *place, stops=stops)
        if verified:
            serial, signature = self._signer.token(remote.name, line.challenge, "/".join(place), payload)
            ask = Ask(self._number, *place, stops, line.challenge, serial, signature)
        return self._number if self._door.send(line.route, ask, payload) else 0

    # --- from stations -----------------------------------------------------------------------------------------

    def _handle_safely(self, arrival: Arrival) -> str:
        """Call `_handle`; after an unforeseen error cut off the sender, so that no other station is affected."""
        try:
            return self._handle(arrival)
        except Exception:
            log.exception("a message of a station's computer cannot be processed")
            self._door.cut(arrival.route, "the lab could not process its message: see the log of its gate")
            return ""

    def _handle(self, arrival: Arrival) -> str:
        """Handle a message; return the name of the station that sent it, "" if it is not identified yet."""
        message = arrival.message
        place = self._by_route.get(arrival.route)
        if place is None:
            if isinstance(message, Hello):
                self._greet(arrival, message)
            elif isinstance(message, Enrol):
                self._enrol(arrival, message)
            else:
                self._door.cut(arrival.route, "it did not say who it is")
            return ""
        remote, line = self._remotes[place[0]], self._remotes[place[0]].lines[place[1]]
        line.heard_at = self._clock()
        if isinstance(message, Beat):
            line.challenge = message.challenge
            if place[1] == COMMANDS:
                remote.listening = message.listening
            self._door.send(arrival.route, Beat())
        elif isinstance(message, Answer):
            self._answer(remote, message, arrival.parts)
        return remote.name

    def _answer(self, remote: Remote, answer: Answer, parts: list[bytes]) -> None:
        pending = remote.pending.pop(answer.number, None)
        if pending is None:
            return
        if not answer.failure and len(parts) == 1:
            pending.server.pass_on(pending.call, parts[0])
            return
        reason = answer.failure[:500] or "the station answered with what cannot be read"
        pending.server.answer(pending.call, _failed(remote, pending.command, reason))

    def _greet(self, arrival: Arrival, hello: Hello) -> None:
        remote = self._find_remote(hello.station)
        if remote is None or not self._allowed.now.may_be(arrival.key, hello.station):
            self._door.cut(arrival.route, f"{hello.station!r:.80} is not known here with this key")
            return
        if hello.role not in (STOPS, COMMANDS):
            self._door.cut(arrival.route, f"{hello.role!r:.40} is for the other port")
            return
        if remote.mirror is None and not self._mirrored(remote):
            self._door.cut(arrival.route, remote.refusal, _TRY_S)
            return
        if reason := apart(hello.release, hello.version, hello.station, lab_side=True):
            if not remote.up:  # while the station is linked, this is a second program
                self._lower(remote, reason)
            self._door.cut(arrival.route, reason)
            return
        if hello.session != remote.session:
            self._leave_lines(remote, "another program has linked this station with the same key", 5.0)
            remote.session = hello.session
        elif (line := remote.lines.pop(hello.role, None)) is not None:
            self._drop_line(line, "another connection of this station has taken its place", 1.0)
        self._adjust(remote)  # answers of the old connection's requests never arrive on the new one
        remote.lines[hello.role] = Line(arrival.route, self._clock())
        self._by_route[arrival.route] = (hello.station, hello.role)
        self._door.send(arrival.route, Welcome(RELEASE, version()))

    def _enrol(self, arrival: Arrival, enrol: Enrol) -> None:
        refusal = apart(enrol.release, enrol.version, "the station", lab_side=True)
        refusal = refusal or self._enrolling.request(
            arrival.route, self._door.address_of(arrival.route), arrival.key, enrol
        )
        if refusal:
            self._door.cut(arrival.route, refusal)

    def _enrolled(self, route: bytes, answer: Enrolled | str) -> None:
        if isinstance(answer, str):
            self._door.cut(route, answer)
            return
        reply = Enrolled(answer.station, answer.lab, answer.tokens, self.second_port)
        self._door.send(route, reply)
        log.info("%s is enrolled", answer.station)

    # --- changes -----------------------------------------------------------------------------------------------

    def _poll(self, now: float) -> None:
        """Check admissions, connections, held presses and pending commands."""
        self._door.poll()
        names = self._allowed.now.names()
        for name in names:
            self._find_remote(name)
        for name in self._remotes.keys() - names:
            self._forget(self._remotes.pop(name))
        for remote in self._remotes.values():
            self._leave_withdrawn(remote)
            if now - remote.tried_at >= _TRY_S:
                self._try(remote)
            self._adjust(remote)
            self._hold_on(remote, now)
            for number, pending in list(remote.pending.items()):
                if now >= pending.until:
                    del remote.pending[number]
                    late = f"sent and not answered within {_PENDING_S:g} s"
                    pending.server.answer(pending.call, _failed(remote, pending.command, late, sent=True))
            if remote.mirror is not None:
                remote.mirror.poll()
                if (streams := self._streams.places.get(remote.name)) is not None:
                    remote.mirror.moved_streams(streams)

    def _find_remote(self, name: str) -> Remote | None:
        """Return the record of a station, created if needed; None if the station is not enrolled."""
        if name not in self._remotes and name in self._allowed.now.names():
            self._remotes[name] = Remote(name)
        return self._remotes.get(name)

    def _try(self, remote: Remote) -> None:
        """Create the station's mirror or streams if they are missing."""
        if remote.mirror is None:
            self._mirrored(remote)
        elif remote.name not in self._streams.places:
            remote.tried_at = self._clock()
            self._streams.serve(remote.name, remote.mirror.station_dir)

    def _mirrored(self, remote: Remote) -> bool:
        """Create the station's mirror and publish its streams; return False, with `refusal` set, if that fails."""
        remote.tried_at = self._clock()
        try:
            remote.mirror = Mirror(self._context, self._stations / remote.name)
        except (MirrorLockedError, TransportError) as error:
            remote.refusal = str(error)
            self._log_once(remote, f"{remote.name} cannot be linked: {error}")
            return False
        remote.mirror.lower("its computer has not connected yet")
        self._streams.serve(remote.name, remote.mirror.station_dir)
        return True

    def _adjust(self, remote: Remote) -> None:
        """Publish the station as linked or lost if that has changed."""
        now = self._clock()
        alive = frozenset(role for role in (STOPS, COMMANDS) if remote.line(role, now) is not None)
        lives = len(alive) == 2
        streams = self._streams.places.get(remote.name)
        up = lives and COORDINATOR in remote.listening and streams is not None
        if remote.mirror is None:
            return
        if (
            remote.alive - alive
        ):  # also the second one: a press may have been sent over it since the first was lost
            remote.lost_at = now
            self._hold(remote)
        remote.alive = alive
        if up and not remote.up and streams is not None:
            try:
                remote.mirror.raise_up(streams)
            except (TransportError, zmq.ZMQError) as error:
                self._log_once(remote, f"{remote.name} cannot be linked: {error}")
                return
            remote.up = True
            self._log_once(remote, f"{remote.name} is linked")
        elif not up and remote.up:
            self._hold(remote)
            self._lower(remote, _NOT_RUNNING if lives else _LOST)
            remote.up = False
        elif not up and lives and streams is not None:
            self._lower(remote, _NOT_RUNNING)
        if remote.up:
            remote.mirror.pictures(MEDIA in remote.listening)
        if remote.held:
            remote.held = [press for press in remote.held if not self._pass_press(remote, press)]

    def _hold(self, remote: Remote) -> None:
        """Drop pending commands, whose answers were lost with the link.

        Presses among them are held instead, and are sent again if the link returns in time.
        """
        for pending in remote.pending.values():
            if pending.press is not None:
                pending.press.sent = True
                self._hold_press(remote, pending.press)
        remote.pending.clear()

    def _hold_press(self, remote: Remote, press: PendingPress) -> None:
        """Hold a press until the link returns; if too many are held, drop the oldest and answer its sender."""
        remote.held.append(press)
        if len(remote.held) > _MOST_HELD:
            self._give_up(remote, remote.held.pop(0))

    def _lower(self, remote: Remote, reason: str) -> None:
        """Make the station appear as lost; `reason`, which is published, says why it cannot be commanded."""
        if remote.told != reason and remote.mirror is not None:
            remote.mirror.lower(reason)
            self._log_once(remote, reason)

    def _hold_on(self, remote: Remote, now: float) -> None:
        """Answer the senders of held presses if the link does not return soon.

        These presses are still sent if it returns; presses older than `_HELD_S` are dropped.
        """
        for press in list(remote.held):
            link_lost = now - remote.lost_at > _HOPE_S  # lost before the press
            if link_lost or now - press.at > _HOPE_S:
                self._give_up(remote, press)
            if now - press.at > _HELD_S:
                remote.held.remove(press)

    def _give_up(self, remote: Remote, press: PendingPress) -> None:
        """Answer the sender of a held press, unless the sender has an answer already."""
        was_told, press.told = press.told, True
        if not was_told and remote.mirror is not None:
            remote.mirror.estops.answer(press.call, _not_sent(remote, press.command, press.sent))

    def _lose(self, routes: list[bytes]) -> None:
        """Remove the connections `routes`, which have ended."""
        for route in routes:
            place = self._by_route.pop(route, None)
            remote = self._remotes.get(place[0]) if place is not None else None
            if remote is None or place is None:
                continue
            line = remote.lines.get(place[1])
            if line is not None and line.route == route:
                del remote.lines[place[1]]
                self._adjust(remote)
        routes.clear()

    def _leave_withdrawn(self, remote: Remote) -> None:
        """Cut off connections whose key no longer belongs to the station."""
        for role, line in list(remote.lines.items()):
            if not self._allowed.now.may_be(self._door.key_of(line.route), remote.name):
                del remote.lines[role]
                self._drop_line(line, "the lab has withdrawn or replaced this station's key", 30.0)

    def _forget(self, remote: Remote) -> None:
        """Remove a station that is no longer enrolled."""
        self._leave_lines(remote, "the lab has withdrawn this station's key", 30.0)
        self._streams.leave(remote.name)
        self._close(remote, "the key of its computer was withdrawn")

    def _close(self, remote: Remote, reason: str) -> None:
        self._hold(remote)
        for press in remote.held:
            self._give_up(remote, press)
        if remote.mirror is not None:
            remote.mirror.close(reason)

    def _leave_lines(self, remote: Remote, reason: str, again_s: float) -> None:
        for line in remote.lines.values():
            self._drop_line(line, reason, again_s)
        remote.lines.clear()

    def _drop_line(self, line: Line, reason: str, again_s: float) -> None:
        self._by_route.pop(line.route, None)
        self._door.cut(line.route, reason, again_s)

    def _log_once(self, remote: Remote, text: str) -> None:
        if remote.told != text:
            remote.told = text
            if self._seldom.due(f"{remote.name}: {text}"):  # a computer may alternate between two reasons
                log.warning("%s: %s", remote.name, text)


def _payload(mirror: Mirror, call: IncomingMessage, command: Command) -> tuple[bytes, bool]:
    """Return the payload to pass on, and whether the web has signed it.

    An unsigned command is encoded anew, so that only its decoded fields reach the station.
    """
    if call.signature and mirror.key.verifies(call.payload, call.signature):
        return call.payload, True
    return encode(command), False


def _unsigned(command: Command) -> str:
    return (
        f"{command.kind} is not signed by this lab's web: a program of the lab's computer cannot command a station "
        "elsewhere; allowed: stops, and python -m runtime.ctl on the station's own computer"
    )


def _not_sent(remote: Remote, command: Command, sent: bool = False) -> Ack:
    state = "sent and not answered" if sent else "not sent"
    return _failed(remote, command, f"{state}, the link to {remote.name} is lost", sent)


def _failed(remote: Remote, command: Command, reason: str, sent: bool = False) -> Ack:
    """Return the answer that the lab gives for the station; the answer to a failed press demands the hardware stop.

    A command that was sent is never "refused", because it may have been carried out.
    """
    if command.kind == "estop":
        return Ack(command.uuid, "failed", f"USE THE HARDWARE STOP: {reason}", data={"station": remote.name})
    failed = sent or command.kind in STOPPING
    return Ack(command.uuid, "failed" if failed else "refused", reason, kind=command.kind)
