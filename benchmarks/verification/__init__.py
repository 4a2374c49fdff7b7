"""Problems of fracture mechanics and of retraction with known answers, stated with xfemnav's public pieces."""
