"""Run jobs on a cluster: Ray and Slurm."""
