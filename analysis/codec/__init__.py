"""What the page codec is worth: net user bytes on recorded pages, drawn blocks, damaged pages, speed."""
