"""A running server: admission of commands, requests, leases, status, publishing."""
