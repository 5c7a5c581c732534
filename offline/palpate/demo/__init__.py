"""The demonstration: builds a scene, serves it in a second process, touches it, and draws the forces."""

from palpate.demo.run import run_demo, show

__all__ = ["run_demo", "show"]
