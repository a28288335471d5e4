"""Global localization: the pose without a prior."""
