"""Many trials, and the questions that they answer: plans, trials, sweeps, studies and what these found."""
