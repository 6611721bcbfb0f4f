"""The one kind of error that a user's input can cause."""


class TwofoldError(Exception):
    """What was expected, what came, where, and what to do: one sentence, shown without a traceback.

    The command line prints it and exits with code 2. Everything else that is raised is a fault of ours.
    """
