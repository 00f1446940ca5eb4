"""Common infrastructure without mechanics: devices, batch arithmetic, threads, memory, time, files."""
