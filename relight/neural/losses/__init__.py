"""Terms of a neural fit's loss, one idea a module; plain torch, finite with their gradients everywhere."""
