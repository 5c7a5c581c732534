"""Build physics models of viscoelastic soft tissue and reduce them for a 1 kHz haptic loop."""
