"""Attention: features, conspicuity, saliency, hierarchical selection of candidates."""
