"""The client library: connection, tools and decoders. It needs eclipse-zenoh and msgpack only.

with Connection() as connection, Tool(connection) as tool:
    tool.move(tool.at_depth(0.003))
    print(tool.take_force())
"""

from palpate_client.connection import Connection, steps
from palpate_client.contract import Contract
from palpate_client.errors import (
    ClientError,
    ConfigurationError,
    DeviceLost,
    Incompatible,
    Refused,
    ServerGone,
    ToolLost,
)
from palpate_client.messages import (
    Description,
    Force,
    Frame,
    Geometry,
    Surface,
    ToolDescription,
    decode_geometry,
    decode_surface,
)
from palpate_client.tool import OneSidedContact, Tool
from palpate_client.wire import MalformedMessage

__all__ = [
    "ClientError",
    "ConfigurationError",
    "Connection",
    "Contract",
    "Description",
    "DeviceLost",
    "Force",
    "Frame",
    "Geometry",
    "Incompatible",
    "MalformedMessage",
    "OneSidedContact",
    "Refused",
    "ServerGone",
    "Surface",
    "Tool",
    "ToolDescription",
    "ToolLost",
    "decode_geometry",
    "decode_surface",
    "steps",
]
