"""Other finite-element packages on the same loads, each in a process of its own."""
