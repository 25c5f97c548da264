"""What the learners of action values share: how they explore, and for how long."""

from __future__ import annotations

from dataclasses import dataclass, fields

from gridnav.problem.types import InputError


@dataclass(frozen=True)
class EpsilonGreedyConfig:
    """Hyper-parameters of Q-learning and DQN alike."""

    seed: int = 0
    """Of the environments, of exploration and, in a network, of weights and batches."""
    num_envs: int = 1
    """Environments stepped together."""
    learning_rate: float = 0.1
    """Of a table, the share of the temporal-difference error that a visit corrects; of a network, Adam's step size."""
    learning_rate_end: float | None = None
    """If given, the learning rate falls linearly to this, over the planned steps or the episodes."""
    gamma: float = 0.99
    """Discount per step, in [0, 1]."""
    epsilon_start: float = 1.0
    """Probability of a random action at the beginning."""
    epsilon_end: float = 0.1
    """The same at the end; it falls linearly over the planned steps."""
    epsilon_decay: float | None = None
    """If given, epsilon falls by this factor with every episode instead, down to ``epsilon_end``."""
    episodes: int | None = None
    """If given, training ends with this episode."""
    exploring_starts: bool = False
    """Training episodes start anywhere, and not where the task says (Sutton and Barto 2018, section 5.3)."""

    def __post_init__(self) -> None:
        check_numbers(self)

    def epsilon(self, share: float, episodes: int) -> float:
        """Probability of a random action.

        Args:
            share: Of the planned steps that are taken, in [0, 1].
            episodes: That have ended.
        """
        if self.epsilon_decay is None:
            return self.epsilon_start + (self.epsilon_end - self.epsilon_start) * share
        return max(self.epsilon_end, self.epsilon_start * self.epsilon_decay**episodes)

    def rate(self, share: float, episodes: int) -> float:
        """Learning rate.

        Args:
            share: Of the planned steps that are taken, in [0, 1].
            episodes: That have ended.
        """
        if self.learning_rate_end is None:
            return self.learning_rate
        if self.episodes is not None:
            share = max(share, min(1.0, episodes / self.episodes))
        return self.learning_rate + (self.learning_rate_end - self.learning_rate) * share

    def is_over(self, episodes: int) -> bool:
        """Whether this many ended episodes are all that training may have."""
        return self.episodes is not None and episodes >= self.episodes


SHARES = {
    "gamma",
    "gae_lambda",
    "epsilon_start",
    "epsilon_end",
    "epsilon_decay",
    "target_success",
    "exploring_starts",
    "teacher_share",
}
"""Hyper-parameters within [0, 1]; whole numbers are at least 1 and other numbers positive unless named below."""
FROM_ZERO = {"seed", "warm_up", "ent_coef", "n_validations", "critic_only_steps", "teacher_weight"}
ANY = {"log_std_init", "log_std_final", "initial_forward"}


def check_numbers(config: object) -> None:
    """Whether every hyper-parameter is in its range.

    Raises:
        InputError: When one is not; the message names it, its value and the rule.
    """
    for field in fields(config):  # type: ignore[arg-type]
        name, value = field.name, getattr(config, field.name)
        if value is None or isinstance(value, bool | str | tuple):
            continue
        rule = ""
        if not -1e300 < value < 1e300:
            rule = "a finite number"
        elif name in SHARES and not 0 <= value <= 1:
            rule = "in [0, 1]"
        elif name in FROM_ZERO and value < 0:
            rule = "at least 0"
        elif name not in SHARES | FROM_ZERO | ANY and value <= 0:
            rule = "at least 1" if isinstance(value, int) else "positive"
        if rule:
            raise InputError(f"{name} {value} of {type(config).__name__} must be {rule}")
