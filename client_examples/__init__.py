"""Small programs that a user copies: each runs as a script and needs only eclipse-zenoh and msgpack."""
