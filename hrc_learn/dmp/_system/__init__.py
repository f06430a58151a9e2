"""The linear system behind a primitive: spring, phase, basis and their exact response."""
