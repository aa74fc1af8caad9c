"""Robot arms: URDF files, kinematics, dynamics, postures and collisions."""
