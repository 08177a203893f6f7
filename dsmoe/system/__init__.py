"""What a run asks of the machine: files, output folders, signals, memory, time and progress bars."""
