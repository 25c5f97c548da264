"""What an episode's randomization comes to: numbers that depend on environment, quantity and episode, on nothing else.

Numbers are counted out, not taken from a stream (SplitMix64, Steele, Lea and Flood 2014, OOPSLA, as a hash of key,
quantity, episode and count): a quantity that is switched on changes the draws of no other one, no environment those of
another, and there is no state but the counters.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from gridnav.problem.types import AnyArray, BoolArray, FloatArray, IntArray

from .randomization import PARAMETERS, Randomization

Keys = NDArray[np.uint64]
Ids = IntArray | slice
"""Some environments, or ``EVERYONE``."""
EVERYONE = slice(None)
NAMES = tuple(PARAMETERS)
COLUMN = {name: column for column, name in enumerate(NAMES)}
"""Column of each quantity in what was drawn."""
NOMINAL: FloatArray = np.array([parameter.nominal for parameter in PARAMETERS.values()])
LOWEST: FloatArray = np.array([parameter.lowest for parameter in PARAMETERS.values()])
HIGHEST: FloatArray = np.array([parameter.highest for parameter in PARAMETERS.values()])
BRANCH = 0x64726177
"""Branch of an environment's seed sequence from which its key comes: larger than any environment's number in a batch,
so that no other generator uses it."""

WINDOW = 120
"""Episodes at the present strength by which a curriculum decides."""
WIDENS, NARROWS = 0.85, 0.6
"""Success from which on ranges widen, and below which they narrow."""
STEP = 0.2
"""Of the strength, at each decision."""
NO_DECISION = -1
"""An episode that counts for no decision: its strength is not the curriculum's, or it began before the last one."""


def wheel_factors(ratio: FloatArray) -> FloatArray:
    """Radius of the left and the right wheel over their mean, shape ``(n, 2)``, given right over left, ``(n,)``."""
    factors: FloatArray = np.stack([2.0 / (1.0 + ratio), 2.0 * ratio / (1.0 + ratio)], axis=1)
    return factors


class Draws:
    """What each of ``n`` environments has drawn for its episode.

    Args:
        randomization: Ranges and laws.
        n: Environments.
    """

    def __init__(self, randomization: Randomization, n: int) -> None:
        self.randomization = randomization
        self.names = randomization.names
        # The maze is the whole batch's: who draws it writes down what was drawn.
        own = [name for name in self.names if PARAMETERS[name].acts_on != "layout"]
        self.columns = np.array([COLUMN[name] for name in own], dtype=np.int64)
        ranges = [getattr(randomization, name) for name in own]
        self._is_log = np.array([one.law == "log" for one in ranges], dtype=bool)
        self._low, self._high = (np.array([getattr(one, end) for one in ranges]) for end in ("low", "high"))
        nominal = NOMINAL[self.columns]
        self._lowest, self._highest = np.minimum(self._low, nominal), np.maximum(self._high, nominal)
        # Other names than those of the numbers within an episode: a noise's size says nothing of its values.
        self._ids = np.array([name_id(f"size of {name}") for name in own], dtype=np.uint64)
        self.values: FloatArray = np.tile(NOMINAL, (n, 1))
        """Of every quantity, in its own unit, shape ``(n, len(NAMES))``; nominal where nothing is drawn."""
        self.keys: Keys = np.zeros(n, dtype=np.uint64)
        self.episodes = np.zeros(n, dtype=np.int64)
        self.curriculum = Curriculum.begin(n)

    def use(self, generators: list[np.random.Generator]) -> None:
        """Take the environments' keys from what their generators were seeded with, without drawing from these."""
        self.keys[:] = [_key(generator) for generator in generators]
        self.episodes[:] = 0
        self.curriculum.restart()

    def draw(self, ids: IntArray) -> None:
        """Draw for the next episode of the given environments."""
        self.episodes[ids] += 1
        if not len(self.columns):
            return
        shares = np.empty((len(ids), len(self.columns)))
        _shares(self.keys[ids], self._ids, self.episodes[ids], shares)
        # By the quantity's law: uniform between the ends, or so in its logarithm.
        low, high, nominal = (self._by_law(ends) for ends in (self._low, self._high, NOMINAL[self.columns]))
        if self.randomization.curriculum:
            strength = self.curriculum.strength_for(ids, self.keys[ids], self.episodes[ids])[:, None]
            low, high = nominal + strength * (low - nominal), nominal + strength * (high - nominal)
        drawn = low + (high - low) * shares
        drawn[:, self._is_log] = np.exp(drawn[:, self._is_log])
        # The exponential of a logarithm may miss an end by the last bit.
        self.values[np.ix_(ids, self.columns)] = np.clip(drawn, self._lowest, self._highest)

    def _by_law(self, values: FloatArray) -> FloatArray:
        """Values of the drawn quantities, or their logarithms where these are uniform."""
        by_law = values.astype(np.float64)
        by_law[self._is_log] = np.log(by_law[self._is_log])
        return by_law

    def __getitem__(self, name: str) -> FloatArray:
        """What was drawn of a quantity, a view of shape ``(n,)``."""
        return self.values[:, COLUMN[name]]

    def varies(self, *names: str) -> bool:
        """Whether one of these quantities is not always nominal."""
        return not set(names).isdisjoint(self.names)

    def shares(self, name: str, counts: IntArray, n: int, ids: Ids = EVERYONE) -> FloatArray:
        """Numbers in [0, 1) of this episode for a quantity, shape ``(m, n)``.

        Args:
            name: The quantity, or what else a number is for.
            counts: How often each of these environments asked before in this episode, shape ``(m,)``.
            n: How many numbers at once, always the same for a name.
            ids: Which environments.
        """
        numbers = np.empty((len(counts), n))
        _fill(self.keys[ids], np.uint64(name_id(name)), self.episodes[ids], counts, False, numbers)
        return numbers

    def normals(self, name: str, counts: IntArray, n: int, ids: Ids = EVERYONE) -> FloatArray:
        """The same as standard normal numbers."""
        numbers = np.empty((len(counts), n))
        _fill(self.keys[ids], np.uint64(name_id(name)), self.episodes[ids], counts, True, numbers)
        return numbers

    def arrays(self) -> dict[str, AnyArray]:
        """Everything that decides what comes next, by name; the arrays themselves."""
        return {
            "drawn": self.values,
            "keys": self.keys,
            "episodes": self.episodes,
            "curriculum": self.curriculum.state,
            "counts_for": self.curriculum.counts_for,
        }

    def info(self) -> dict[str, FloatArray]:
        """What was drawn, by name, shape ``(n,)`` each; fresh arrays."""
        return {name: self[name].copy() for name in self.names}


@dataclass
class Curriculum:
    """One strength for all ranges, in [0, 1], that follows the success of episodes at the present strength.

    Half of the episodes are at it, the others anywhere below, so that what was learnt is not forgotten (automatic
    domain randomisation, OpenAI et al. 2019, arXiv 1910.07113, section 5). It decides by the first ``WINDOW`` episodes
    that *begin* at a strength, not by the first to end, which are the good ones; and as soon as those that are still
    under way cannot change the decision.
    """

    state: FloatArray
    """Strength, how many of the episodes that count for the next decision began, ended and succeeded, and the decisions
    so far, shape ``(5,)``."""
    counts_for: IntArray
    """Decision for which each environment's episode counts, shape ``(n,)``; ``NO_DECISION`` for none."""
    leads: bool = True
    """It does not share the state of another one."""

    @classmethod
    def begin(cls, n: int) -> Curriculum:
        """With strength 0."""
        return cls(np.zeros(5), np.full(n, NO_DECISION))

    def follow(self, leader: Curriculum) -> None:
        """Be one curriculum with that of other environments from now on."""
        self.state, self.leads = leader.state, False

    def restart(self) -> None:
        """Back to strength 0; who follows leaves that to the one it follows."""
        self.counts_for[:] = NO_DECISION
        if self.leads:
            self.state[:] = 0.0

    @property
    def strength(self) -> float:
        """The present one."""
        return float(self.state[0])

    def note(self, ids: IntArray, is_over: BoolArray, successes: BoolArray) -> None:
        """These environments leave their episodes: widen or narrow once it is settled.

        Args:
            ids: The environments.
            is_over: Which of the episodes ended by themselves; others are cut short, and another one takes their place.
            successes: Which of them arrived.
        """
        _, _, _, _, decision = self.state
        is_sample = self.counts_for[ids] == decision
        counts, cut = is_sample & is_over, is_sample & ~is_over
        self.counts_for[ids] = NO_DECISION
        self.state[1:4] += -cut.sum(), counts.sum(), successes[counts].sum()
        _, _, ended, arrived, _ = self.state
        widens = arrived >= WIDENS * WINDOW
        narrows = ended - arrived > (1.0 - NARROWS) * WINDOW
        if widens or narrows or ended >= WINDOW:
            change = STEP if widens else -STEP if narrows else 0.0
            # Rounded, so that steps make 1.
            # Episodes under way were at the strength before: they count for a decision that has been made.
            self.state[:] = min(max(round(self.strength + change, 6), 0.0), 1.0), 0, 0, 0, decision + 1

    def strength_for(self, ids: IntArray, keys: Keys, episodes: IntArray) -> FloatArray:
        """Strength of the next episode of each environment, shape ``(len(ids),)``."""
        shares = np.empty((len(ids), 2))
        _shares(keys, np.array([name_id("curriculum"), name_id("strength")], dtype=np.uint64), episodes, shares)
        is_present = shares[:, 0] < 0.5
        wanted = is_present & (self.state[1] + np.cumsum(is_present) <= WINDOW)
        self.counts_for[ids] = np.where(wanted, int(self.state[4]), NO_DECISION)
        self.state[1] += wanted.sum()
        return np.where(is_present, self.strength, self.strength * shares[:, 1])


def name_id(name: str) -> int:
    """A number that belongs to a name, whatever other names there are."""
    return zlib.crc32(name.encode())


def _key(generator: np.random.Generator) -> int:
    seeds = generator.bit_generator.seed_seq
    assert isinstance(seeds, np.random.SeedSequence)
    branch = np.random.SeedSequence(seeds.entropy, spawn_key=(*seeds.spawn_key, BRANCH))
    return int(branch.generate_state(1, np.uint64)[0])


@numba.njit(cache=True)
def _mix(number: np.uint64) -> np.uint64:
    """SplitMix64's finaliser."""
    number = (number ^ (number >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    number = (number ^ (number >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return number ^ (number >> np.uint64(31))


@numba.njit(cache=True)
def _share(key: np.uint64, name: np.uint64, episode: int, count: int) -> float:
    """A number in [0, 1) for an environment, a quantity, an episode and a count within it."""
    golden = np.uint64(0x9E3779B97F4A7C15)
    number = _mix(key + golden * (name + np.uint64(1)))
    number = _mix(number + golden * (np.uint64(episode) + np.uint64(1)))
    number = _mix(number + golden * (np.uint64(count) + np.uint64(1)))
    return float(number >> np.uint64(11)) * 2.0**-53


@numba.njit(cache=True)
def _normal(key: np.uint64, name: np.uint64, episode: int, count: int) -> float:
    """A standard normal number (Box and Muller 1958)."""
    radius = np.sqrt(-2.0 * np.log(1.0 - _share(key, name, episode, 2 * count)))
    return radius * np.cos(2.0 * np.pi * _share(key, name, episode, 2 * count + 1))


@numba.njit(cache=True)
def _shares(keys: Keys, names: Keys, episodes: IntArray, shares: FloatArray) -> None:
    for i in range(len(keys)):
        for k in range(len(names)):
            shares[i, k] = _share(keys[i], names[k], episodes[i], 0)


@numba.njit(cache=True)
def _fill(
    keys: Keys, name: np.uint64, episodes: IntArray, counts: IntArray, is_normal: bool, numbers: FloatArray
) -> None:
    n = numbers.shape[1]
    for i in range(len(keys)):
        for k in range(n):
            count = counts[i] * n + k
            if is_normal:
                numbers[i, k] = _normal(keys[i], name, episodes[i], count)
            else:
                numbers[i, k] = _share(keys[i], name, episodes[i], count)
