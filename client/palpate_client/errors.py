"""What can go wrong for a client, by cause."""

from __future__ import annotations


class ClientError(Exception):
    """Base of all errors of this package; the message is for a person."""


class ConfigurationError(ClientError):
    """The endpoint or the Zenoh configuration file can't be used. Trying again does not help."""


class ServerGone(ClientError):
    """No server answers, or the one that did is gone, stopping or silent. It may come back."""


class ToolLost(ClientError):
    """The server runs, but the tool is no longer ours: acquire it again, or give up."""


class DeviceLost(ClientError):
    """The haptic device or its driver can't be used, or is gone."""


class Incompatible(ClientError):
    """The server speaks another schema version, or serves another model than the one that was agreed on."""


class Refused(ClientError):
    """The server refused a request.

    Attributes
    ----------
    reason: one of the reasons in docs/wire.md, such as "held".
    words: the server's own words.
    """

    def __init__(self, reason: str, words: str) -> None:
        super().__init__(f"{words} ({reason})")
        self.reason = reason
        self.words = words
