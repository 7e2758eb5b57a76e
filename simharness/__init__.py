"""The proof: cluttered tables in simulation, cleared grasp by grasp through the service, with success rates counted."""
