"""Space: cuts as level sets at the nodes of a mesh of simplices, and the parts that they leave."""
