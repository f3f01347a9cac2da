"""The one exception that stands for a user's mistake."""


class UserError(ValueError):
    """A mistake a user can mend: one line that says what, where and what to do.

    Commands print it without a traceback and end with exit status 2; nodes report it in
    /diagnostics. Everything else is a bug and keeps its traceback.
    """
