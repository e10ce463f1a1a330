"""One vehicle over time: aligning, running, questioned, restarted, and what outlasts a restart."""
