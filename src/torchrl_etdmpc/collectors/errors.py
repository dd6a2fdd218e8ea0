"""What an environment or a policy can do to a step."""


class NonFiniteError(RuntimeError):
    """The environment or the policy returned a value that is not finite."""


class SimulatorError(RuntimeError):
    """The environment raised an exception.

    Attributes:
        episode_ended (bool): whether it did so in the reset behind an episode that ended and was stored.
    """

    episode_ended = False
