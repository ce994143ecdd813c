"""Solvers: every public function turns an Operator into another one, its inverse."""
