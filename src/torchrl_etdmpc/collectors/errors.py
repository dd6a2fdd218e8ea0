"""What an environment or a policy can do to a step."""


class NonFiniteError(RuntimeError):
    """The environment or the policy returned a value that is not finite."""


class SimulatorError(RuntimeError):
    """The environment raised an exception."""
