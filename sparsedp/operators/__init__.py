"""The catalogue: every public function takes a grid (or a space) and returns an Operator."""
