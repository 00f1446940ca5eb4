"""Other FEM packages on the same loads, each in a separate process."""
