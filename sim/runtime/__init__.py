"""Common infrastructure without mechanics: devices, batch arithmetic, threads, memory, timing and files."""
