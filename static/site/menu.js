// The account's menu closes when something else is pressed.

const menu = document.querySelector(".bar-user");

if (menu) {
  document.addEventListener("click", (event) => {
    if (!menu.contains(event.target)) menu.open = false;
  });
}
