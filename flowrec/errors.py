"""What can go wrong, told in one line: what, where, what next.

The command line prints these without a traceback; anything else is a defect of flowrec.
"""


class FlowrecError(Exception):
    """Something failed that a person can mend. Exit status 1."""

    exit_status = 1


class UsageError(FlowrecError):
    """A bad argument, option or configuration. Exit status 2."""

    exit_status = 2


class ChipError(UsageError):
    """A mask, opening or calibration that no flow can be computed on."""


class FlowError(FlowrecError):
    """The flow solver has no answer."""


class RigError(FlowrecError):
    """Camera, amplifier or simulated rig refused to work."""


class SessionError(FlowrecError):
    """A session file can not be read or written."""
