"""A bus of Feetech STS3215 servos behind a pseudo-terminal, at the level of its protocol.

Packets, checksums, registers and replies as LeRobot and the maker's SDK use them (protocol 0).
A simulator: nothing that runs against it has been run on hardware.
"""

import os
import pty
import threading
import time
import tty
from contextlib import suppress

PING, READ, WRITE, SYNC_READ, SYNC_WRITE, BROADCAST = 1, 2, 3, 0x82, 0x83, 0xFE
MODEL, TORQUE, GOAL, LOCK, POSITION, VELOCITY, STATUS = 3, 40, 42, 55, 56, 58, 65
MIN_LIMIT, MAX_LIMIT, OFFSET, VOLTAGE, TEMPERATURE = 9, 11, 31, 62, 63
HOT = 4
"""Bit of the status for the temperature."""


class Servo:
    """One servo: 256 registers, and an output that follows its goal with a lag."""

    def __init__(self, position=2048, low=0, high=4095, lag=0.03, fastest=3400.0):
        self.memory = bytearray(256)
        self.memory[0:3] = bytes((3, 10, 0))  # firmware
        self.put(MODEL, 777)
        self.put(MIN_LIMIT, low)
        self.put(MAX_LIMIT, high)
        self.memory[VOLTAGE], self.memory[TEMPERATURE] = 74, 30
        self.position, self.speed = float(position), 0.0
        self.lag, self.fastest = lag, fastest  # [s], [steps/s]
        self.since = time.monotonic()
        self.put(GOAL, position)
        self.goals = []
        self.blocked = False

    def put(self, address, value):
        self.memory[address : address + 2] = int(value).to_bytes(2, "little")

    def word(self, address):
        return int.from_bytes(self.memory[address : address + 2], "little")

    def heat(self):
        """Report too high a temperature, and cut the torque as the servo does."""
        self.memory[STATUS], self.memory[TEMPERATURE], self.memory[TORQUE] = HOT, 80, 0

    def cool(self):
        self.memory[STATUS], self.memory[TEMPERATURE] = 0, 30

    def move(self):
        now = time.monotonic()
        dt, self.since = now - self.since, now
        self.speed = 0.0
        if self.memory[TORQUE] and not self.blocked and dt > 0:
            behind = self.word(GOAL) - self.position
            step = behind * min(1.0, dt / self.lag)
            step = max(-self.fastest * dt, min(self.fastest * dt, step))
            self.position, self.speed = self.position + step, step / dt
        self.put(POSITION, round(self.position))
        speed = min(round(abs(self.speed)), 0x7FFF)
        self.put(VELOCITY, speed | (0x8000 if self.speed < 0 else 0))

    def write(self, address, data):
        # Assumed of the firmware: an arm whose torque comes on keeps still.
        if address == TORQUE and data[0] and not self.memory[TORQUE]:
            self.put(GOAL, round(self.position))
        self.memory[address : address + len(data)] = data
        if address == GOAL:
            low, high = self.word(MIN_LIMIT), self.word(MAX_LIMIT)
            self.put(GOAL, min(high, max(low, self.word(GOAL))))
            self.goals.append((time.monotonic(), self.word(GOAL)))
        if self.memory[STATUS]:
            self.memory[TORQUE] = 0  # until the cause is gone


class FeetechBus:
    """Servos on one wire; `port` is what LeRobot opens.

    Attributes:
        servos: Servos by number.
        silent: Numbers of servos that do not answer.
        lose: Replies to lose next.
        garble: Replies whose checksum is wrong next.
        refused: Packets to the servos with a wrong checksum.
    """

    def __init__(self, servos):
        self.servos, self.silent = servos, set()
        self.lose = self.garble = self.refused = 0
        self._ours, self._theirs = pty.openpty()
        tty.setraw(self._theirs)
        self.port = os.ttyname(self._theirs)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for end in (self._theirs, self._ours):
            with suppress(OSError):
                os.close(end)

    def _serve(self):
        received = bytearray()
        with suppress(OSError):
            while data := os.read(self._ours, 4096):
                received += data
                while packet := self._packet(received):
                    self._answer(*packet)

    def _packet(self, received):
        """The next whole packet: number, instruction and parameters."""
        while len(received) >= 6:
            if received[:2] != b"\xff\xff":
                del received[0]
                continue
            length = received[3] + 4
            if len(received) < length:
                return None
            packet = bytes(received[:length])
            del received[:length]
            if ~sum(packet[2:-1]) & 0xFF == packet[-1]:
                return packet[2], packet[4], packet[5:-1]
            self.refused += 1
        return None

    def _answer(self, number, instruction, data):
        if instruction == SYNC_READ:
            for one in data[2:]:
                self._reply(one, data[0], data[1])
        elif instruction == SYNC_WRITE:
            address, size = data[:2]
            for k in range(2, len(data), size + 1):
                if servo := self.servos.get(data[k]):
                    servo.move()
                    servo.write(address, data[k + 1 : k + 1 + size])
        else:
            for one in self.servos if number == BROADCAST else (number,):
                if instruction == WRITE and one in self.servos:
                    self.servos[one].move()
                    self.servos[one].write(data[0], data[1:])
                self._reply(one, *(data if instruction == READ else (0, 0)))

    def _reply(self, number, address, size):
        servo = self.servos.get(number)
        if servo is None or number in self.silent:
            return
        if self.lose:
            self.lose -= 1
            return
        servo.move()
        status = servo.memory[STATUS]
        body = bytes((number, size + 2, status)) + servo.memory[address : address + size]
        check = ~sum(body) & 0xFF
        if self.garble:
            self.garble, check = self.garble - 1, check ^ 0x55
        os.write(self._ours, b"\xff\xff" + body + bytes((check,)))


RANGES = {
    "shoulder_pan": (800, 3300),
    "shoulder_lift": (900, 3100),
    "elbow_flex": (1000, 3050),
    "wrist_flex": (900, 3200),
    "wrist_roll": (0, 4095),
    "gripper": (2000, 3500),
}
"""Calibrated ranges of an SO-101's servos, in steps of 1/4096 of a turn."""


def so101_servos():
    """Servos of an SO-101 in the middle of their ranges."""
    return {
        number: Servo((low + high) // 2, low, high)
        for number, (low, high) in enumerate(RANGES.values(), 1)
    }


def calibration(ranges=RANGES):
    """LeRobot's calibration file of these servos, as JSON."""
    return {
        name: {
            "id": number,
            "drive_mode": 0,
            "homing_offset": 0,
            "range_min": low,
            "range_max": high,
        }
        for number, (name, (low, high)) in enumerate(ranges.items(), 1)
    }
