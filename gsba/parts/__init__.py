"""Maps too large for one process: cut into parts, whose own unknowns are eliminated where they lie.

`folder.PartsWriter` writes a map's observations part by part, `divided_system.optimize_divided`
solves for it, by the same normal equations and the same loop as `gsba.bundle.optimizer.optimize`.
"""
