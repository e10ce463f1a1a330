"""The one exception that reaches the user as a plain line instead of a traceback."""


class InputError(ValueError):
    """What the user gave cannot be used.

    The text is one complete line for the user: which file, topic, option or value, what is wrong
    with it and, where there is one, the way out. Programs print it and exit with status 2; the
    node logs it. It never stands for a defect in this package.
    """
