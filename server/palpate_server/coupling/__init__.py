"""What connects ports with a body: `fixed_patch` for patch models, chosen by `models` from the kind of model."""
