"""Setting up a lab: overview of what exists and what is missing, and the scene editor."""
