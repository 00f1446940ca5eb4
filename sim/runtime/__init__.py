"""What every part runs on: devices, columns of numbers, threads, memory, time, files. No mechanics."""
