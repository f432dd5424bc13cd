"""From a session to a relightable portrait: fitting, lights, rendering and measures."""
