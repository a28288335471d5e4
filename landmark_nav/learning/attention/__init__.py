"""Where to look: features, conspicuity, saliency, hierarchical selection."""
