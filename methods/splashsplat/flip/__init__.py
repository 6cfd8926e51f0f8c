"""FLIP, the paper's ablation: liquid simulated from one observed state on (paper, "Ablation Study")."""
