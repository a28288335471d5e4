"""Bundle adjustment of landmarks, panoramas and walls."""
