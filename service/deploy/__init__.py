"""The service on engines that run many of it: Ray Serve here, Kubernetes and KServe in the folders beside."""
