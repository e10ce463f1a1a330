"""What a vehicle cannot do: slip, where it has wheels or wings, or move while it stands."""
