"""What fixes show to be wrong by themselves: speeds, heights, repetitions, velocities."""
