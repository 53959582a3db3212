"""The space-stable platform with case rotation: simulate, align, identify, navigate, analyse."""
