"""Parts of LeRobot's asynchronous inference: its messages, its pickles without LeRobot, its tensors without torch."""
