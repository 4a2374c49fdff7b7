"""What tissue resists: constitutive laws and stiffness."""
