"""The Zenoh session: server, requests, leases, status."""
