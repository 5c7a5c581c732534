"""Moving-least-squares shape functions on a node cloud."""

from palpate.meshfree.shape_functions import ShapeFunctions, SupportError, shape_functions

__all__ = ["ShapeFunctions", "SupportError", "shape_functions"]
