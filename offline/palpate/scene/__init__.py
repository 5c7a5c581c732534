"""What a scene may say: geometry, material, regions."""
