"""Features of a hash grid to density and color."""
