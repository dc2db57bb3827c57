"""The paper's figures and the ablation, with captions and verdicts."""
