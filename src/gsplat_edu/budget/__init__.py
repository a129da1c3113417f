"""What a training costs on this machine, and how a limit of time or memory is kept."""
