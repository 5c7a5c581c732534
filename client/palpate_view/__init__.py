"""The page of `palpate view`: a session of a running server in the browser, and the mouse as a device.

It is a client like any other: `palpate_client` is all that it imports of palpate. The page itself is viser's.
"""
