"""What a format yields and every stage writes: messages to be, below all that make one."""
