"""The command `gsplat-edu`: it wires data, training and evaluation together."""
