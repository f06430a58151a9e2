"""Defects of the numbers in a LeRobot dataset, each done to a copy of a sound one.

Where a kind concerns one episode it is the second. What is severe loses data, misleads
whoever learns from it, or harms the program that reads it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from broken_copies import STATE, Copy

ACTION = "action"
Change = Callable[[np.ndarray], np.ndarray]


class NotHereError(Exception):
    """The dataset holds nothing that a defect could concern."""


@dataclass(frozen=True)
class Kind:
    """One kind of defect."""

    damage: Callable[[Copy], object]
    severe: bool = True
    local: bool = False
    """Concerns one episode, or one file, which has to be named."""


# Values of the second episode.


def rows(copy: Copy, key: str, episode: int = 1) -> np.ndarray:
    """Values of an episode (frames, components), as they are on disk."""
    if key not in copy.info["features"]:
        raise NotHereError(key)
    file, start, length = copy.data, copy.start, copy.length
    if episode != 1:
        assert episode == 0
        file = copy.data.replace("000001", "000000")
        start, length = 0, copy.start if copy.v3 else None
    column = pq.read_table(copy.root / file, columns=[key]).column(key)
    return np.array(column.to_pylist()[start : None if length is None else start + length])


def put(copy: Copy, key: str, change: Change) -> None:
    """Replace the values of a feature by what `change` makes of them."""
    rows(copy, key)
    copy.change_rows(key, change)


def movers(copy: Copy, key: str = STATE) -> np.ndarray:
    """Components in the order of how far they move and how many values they take.

    What takes few values switches, and is left to kinds of its own.
    """
    values = rows(copy, key)
    levels = np.array([len({*column}) for column in values.T])
    order = np.argsort(-np.ptp(values, axis=0) * (levels > len(values) / 3))
    moving = [i for i in order if levels[i] > len(values) / 3]
    if len(moving) < 2:
        raise NotHereError("nothing moves")
    return np.array(moving)


def pair(copy: Copy) -> tuple[int, int]:
    """Two moving components that are elsewhere."""
    values, moving = rows(copy, STATE), movers(copy)[:6]
    middle = np.median(values, axis=0)
    return int(moving[middle[moving].argmin()]), int(moving[middle[moving].argmax()])


def component(key: str, change: Change) -> Callable[[Copy], None]:
    """A defect of the component that moves most, over the whole of the episode."""

    def damage(copy: Copy) -> None:
        which = movers(copy, key)[0]

        def one(values: np.ndarray) -> np.ndarray:
            values[:, which] = change(values[:, which])
            return values

        put(copy, key, one)

    return damage


def at(frame: float, value: Callable[[np.ndarray], float]) -> Change:
    """Set one value, at a fraction of the episode, to a function of all values."""

    def change(values: np.ndarray) -> np.ndarray:
        values[int(frame * len(values))] = value(values)
        return values

    return change


def whole(key: str, change: Change) -> Callable[[Copy], None]:
    """A defect of all components."""
    return lambda copy: put(copy, key, change)


def both(change: Callable[[Copy, np.ndarray], np.ndarray]) -> Callable[[Copy], None]:
    """A defect of states and their commands alike."""

    def damage(copy: Copy) -> None:
        if ACTION not in copy.info["features"]:
            raise NotHereError(ACTION)
        changed = {key: change(copy, rows(copy, key)) for key in (STATE, ACTION)}
        for key, values in changed.items():
            put(copy, key, lambda _, values=values: values)

    return damage


def exchanged(copy: Copy, values: np.ndarray) -> np.ndarray:
    first, second = pair(copy)
    values[:, [first, second]] = values[:, [second, first]]
    return values


def negated(copy: Copy, values: np.ndarray) -> np.ndarray:
    which = max(pair(copy), key=lambda i: abs(np.median(rows(copy, STATE)[:, i])))
    values[:, which] *= -1
    return values


def turn(values: np.ndarray) -> float:
    """A whole one, in the unit of the values."""
    return 2 * np.pi if np.abs(values).max() < 4 * np.pi else 360.0


def held(values: np.ndarray) -> np.ndarray:
    third = len(values) // 4
    values[third : 3 * third] = values[third]
    return values


def dropout(values: np.ndarray) -> np.ndarray:
    values[int(0.45 * len(values)) : int(0.55 * len(values))] = 0
    return values


def leap(values: np.ndarray) -> np.ndarray:
    values[len(values) // 2 :] += 0.7 * np.ptp(values) + 0.5
    return values


def noisy(values: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).standard_normal(len(values))
    return values + 0.05 * np.ptp(values) * noise


def flipped(values: np.ndarray) -> np.ndarray:
    """Exponents with a bit turned over, in one value of fifty."""
    bits = values.astype(np.float32).view(np.uint32).copy()
    bits.reshape(-1)[::50] ^= 1 << 29
    return bits.view(np.float32).astype(values.dtype)


def shuffled(values: np.ndarray) -> np.ndarray:
    return values[np.random.default_rng(0).permutation(len(values))]


def stale(values: np.ndarray) -> np.ndarray:
    return np.repeat(values[::3], 3, axis=0)[: len(values)]


def resting(values: np.ndarray) -> np.ndarray:
    third = len(values) // 3
    return np.concatenate([np.repeat(values[:1], third, 0), values[:-third]])


def shift(frames: int) -> Change:
    def change(values: np.ndarray) -> np.ndarray:
        moved = np.roll(values, frames, axis=0)
        if frames > 0:
            moved[:frames] = values[0]
        else:
            moved[frames:] = values[-1]
        return moved

    return change


def like_first(keys: tuple[str, ...], noise: float = 0.0) -> Callable[[Copy], None]:
    """The motion of the first episode, in the time of the second."""

    def damage(copy: Copy) -> None:
        for key in keys:
            first, own = rows(copy, key, 0).astype(float), rows(copy, key)
            places = np.linspace(0, len(first) - 1, len(own))
            frames = np.arange(len(first))
            new = np.stack([np.interp(places, frames, column) for column in first.T], axis=1)
            new += noise * np.random.default_rng(0).standard_normal(own.shape)
            put(copy, key, lambda _, new=new: new)

    return damage


def another_command(copy: Copy) -> None:
    """Actions turned round in time: another motion with the same range."""
    put(copy, ACTION, lambda v: v[::-1].copy())


def rates_as_positions(copy: Copy) -> None:
    """In all episodes, commands that are velocities."""
    if ACTION not in copy.info["features"]:
        raise NotHereError(ACTION)
    if rows(copy, STATE).shape != rows(copy, ACTION).shape:
        raise NotHereError("other joints")
    files = sorted((copy.root / "data").glob("*/*.parquet"))
    for file in files:
        table = pq.read_table(file)
        state = np.array(table.column(STATE).to_pylist())
        episodes = np.array(table.column("episode_index").to_pylist())
        rates = np.concatenate(
            [
                np.gradient(state[episodes == i], 1 / copy.info["fps"], axis=0)
                for i in np.unique(episodes)
            ]
        )
        number = table.schema.get_field_index(ACTION)
        column = pa.array(list(rates), table.schema.field(ACTION).type)
        pq.write_table(table.set_column(number, ACTION, column), file)


def switch(change: Change) -> Callable[[Copy], None]:
    """A defect of the component that switches between two levels, such as a gripper."""

    def damage(copy: Copy) -> None:
        values = rows(copy, ACTION)
        two = [i for i, column in enumerate(values.T) if len({*column}) == 2]
        if not two:
            raise NotHereError("nothing switches")

        def one(values: np.ndarray) -> np.ndarray:
            values[:, two[0]] = change(values[:, two[0]])
            return values

        put(copy, ACTION, one)

    return damage


VALUES = {
    "nan in the state": Kind(component(STATE, at(0.3, lambda v: np.nan)), local=True),
    "infinity in an action": Kind(component(ACTION, at(0.3, lambda v: -np.inf)), local=True),
    "a joint that is nan throughout": Kind(component(STATE, lambda v: v * np.nan), local=True),
    "1.3e23 in an action": Kind(component(ACTION, at(0.5, lambda v: 1.3e23)), local=True),
    "bits flipped in actions": Kind(whole(ACTION, flipped), local=True),
    "bits flipped in states": Kind(whole(STATE, flipped), local=True),
    "a million in the state": Kind(component(STATE, at(0.5, lambda v: 1e6)), local=True),
    "a frame far away": Kind(
        component(STATE, at(0.5, lambda v: v[0] + 3 * np.ptp(v) + 1)), severe=False, local=True
    ),
    "a spike of a third of the range": Kind(
        component(STATE, at(0.5, lambda v: v[len(v) // 2] + np.ptp(v) / 3 + 0.1)),
        severe=False,
        local=True,
    ),
    "a spike in an action": Kind(
        component(ACTION, at(0.5, lambda v: v[len(v) // 2] + np.ptp(v) / 3 + 0.1)),
        severe=False,
        local=True,
    ),
    "a joint that leaps and stays": Kind(component(STATE, leap), severe=False, local=True),
    "a turn that wrapped": Kind(
        component(STATE, lambda v: v + turn(v) * (np.arange(len(v)) > len(v) / 2)),
        severe=False,
        local=True,
    ),
    "another unit": Kind(both(lambda _, v: np.rad2deg(v)), local=True),
    "another unit, of the state alone": Kind(whole(STATE, np.deg2rad), local=True),
    "another unit, of actions alone": Kind(whole(ACTION, np.rad2deg), local=True),
    "an encoder that froze": Kind(component(STATE, held), local=True),
    "an encoder that reads zero": Kind(component(STATE, lambda v: 0 * v), local=True),
    "zeros for a tenth of the frames": Kind(
        whole(
            STATE, lambda v: v * (np.abs(np.arange(len(v)) - len(v) / 2) > len(v) / 20)[:, None]
        ),
        local=True,
    ),
    "a state that froze": Kind(whole(STATE, lambda v: np.repeat(v[:1], len(v), 0)), local=True),
    "nothing moves": Kind(both(lambda _, v: np.repeat(v[:1], len(v), 0)), local=True),
    "joints exchanged": Kind(both(exchanged), local=True),
    "joints exchanged, in the state alone": Kind(
        lambda c: put(c, STATE, lambda v: exchanged(c, v)), local=True
    ),
    "joints moved on by one": Kind(both(lambda _, v: np.roll(v, 1, axis=1)), local=True),
    "a joint of the other sign": Kind(both(negated), local=True),
    "a joint of the other sign, in the state alone": Kind(
        component(STATE, lambda v: -v), local=True
    ),
    "a zero that moved": Kind(
        component(STATE, lambda v: v + 0.5 * np.ptp(v) + 0.2), severe=False, local=True
    ),
    "noise": Kind(component(STATE, noisy), severe=False, local=True),
    "few levels": Kind(
        component(STATE, lambda v: np.round(v / np.ptp(v) * 8) * np.ptp(v) / 8),
        severe=False,
        local=True,
    ),
    "clipped": Kind(
        component(STATE, lambda v: np.clip(v, np.quantile(v, 0.35), np.quantile(v, 0.65))),
        severe=False,
        local=True,
    ),
    "frames in disorder": Kind(both(lambda _, v: shuffled(v)), local=True),
    "backwards in time": Kind(both(lambda _, v: v[::-1].copy()), severe=False, local=True),
    "frames recorded three times": Kind(both(lambda _, v: stale(v)), severe=False, local=True),
    "a long rest first": Kind(both(lambda _, v: resting(v)), severe=False, local=True),
    "a copy of another episode": Kind(like_first((STATE, ACTION)), severe=False, local=True),
    "nearly a copy of another episode": Kind(
        like_first((STATE, ACTION), 1e-4), severe=False, local=True
    ),
    "actions 20 frames late": Kind(whole(ACTION, shift(20)), local=True),
    "actions 20 frames early": Kind(whole(ACTION, shift(-20)), local=True),
    "actions of another motion": Kind(another_command, local=True),
    "actions of zero": Kind(whole(ACTION, lambda v: 0 * v), local=True),
    "actions that stay": Kind(whole(ACTION, lambda v: np.repeat(v[:1], len(v), 0)), local=True),
    "actions of half the size": Kind(whole(ACTION, lambda v: v / 2), severe=False, local=True),
    "a joint's command of the other sign": Kind(component(ACTION, lambda v: -v), local=True),
    "actions that copy the state": Kind(
        lambda c: put(c, ACTION, lambda v: rows(c, STATE)), severe=False, local=True
    ),
    "velocities as positions": Kind(rates_as_positions, severe=False),
    "a gripper of the other sense": Kind(
        switch(lambda v: v.max() + v.min() - v), severe=False, local=True
    ),
    "a gripper that stays": Kind(switch(lambda v: 0 * v + v[0]), severe=False, local=True),
}
"""Defects of values."""


def stamps(change: Change) -> Callable[[Copy], None]:
    return whole("timestamp", change)


def period(values: np.ndarray) -> float:
    return float(np.median(np.diff(values)))


STAMPS = {
    "stamps that stall": Kind(stamps(lambda v: np.concatenate([v[:10], v[9:-1]])), local=True),
    "stamps that go back": Kind(
        stamps(lambda v: v - 0.4 * v[-1] * (np.arange(len(v)) > len(v) / 2)), local=True
    ),
    "a stamp of nan": Kind(stamps(at(0.5, lambda v: np.nan)), local=True),
    "stamps in milliseconds": Kind(stamps(lambda v: 1000 * v), local=True),
    "stamps of the wall clock": Kind(stamps(lambda v: v + 1e4), severe=False, local=True),
    "a gap": Kind(
        stamps(lambda v: v + 5 * period(v) * (np.arange(len(v)) >= 15)),
        severe=False,
        local=True,
    ),
    "jitter": Kind(
        stamps(lambda v: v + period(v) * np.random.default_rng(0).uniform(-0.3, 0.3, len(v))),
        severe=False,
        local=True,
    ),
    "half the rate": Kind(stamps(lambda v: 2 * v), severe=False, local=True),
    "frames counted anew": Kind(
        whole("frame_index", lambda v: np.where(v > len(v) / 2, v - len(v) // 2, v)), local=True
    ),
    "another episode's number": Kind(whole("episode_index", lambda v: v + 7), local=True),
    "an index that begins anew": Kind(whole("index", lambda v: v - v[0] + 2), local=True),
    "a task that is not listed": Kind(whole("task_index", lambda v: v + 99), local=True),
}
"""Defects of clocks and counters."""
