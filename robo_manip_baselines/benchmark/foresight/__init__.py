"""Value of foresight to a scripted visual servo, without any learning."""
