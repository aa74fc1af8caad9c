"""Motion: the arm, the compliance law, the exploration path and the closed loop."""
