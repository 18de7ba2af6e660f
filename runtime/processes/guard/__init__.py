"""Guard, process 4: the e-stop."""
