"""A client's side of palpate: facts of the wire, connection, tools and decoders. Needs eclipse-zenoh and msgpack alone."""
