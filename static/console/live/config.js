// What the server tells this page: addresses, names, role. Read once.
const element = document.getElementById("config");

export const config = element ? JSON.parse(element.textContent) : {};
