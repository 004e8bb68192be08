"""The one family of errors a user of the toolkit can meet.

Every message says, in one line, what happened, where, and what to do next. The command line turns any of
them into exit code 2 and that line; anything else that escapes is a defect of the toolkit.
"""

from __future__ import annotations


class ToolkitError(Exception):
    """A mistake or a condition the user can act on. Base of every error the toolkit raises on purpose."""


class ToolkitWarning(UserWarning):
    """Something that works, and that its user should know of: one line, as of an error."""


class SessionError(ToolkitError):
    """A session file cannot be read, written or trusted."""


class CalibrationError(ToolkitError):
    """A calibration is missing, malformed, or not observable from the data it was given."""


class DeviceError(ToolkitError):
    """A camera or a robot does not answer, answers wrongly, or stopped."""
