"""Reports of missions as pages that need nothing but a browser, and moving pictures of them."""
