"""From a measured record of a tissue to its stiffness at rest and its Prony series."""
