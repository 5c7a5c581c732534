"""The scene file: geometry, material, regions, reduction."""
