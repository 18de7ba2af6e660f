"""Parts of LeRobot's asynchronous inference: messages, pickles without LeRobot, tensors without torch."""
