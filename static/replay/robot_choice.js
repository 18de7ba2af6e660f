// The choice of the robot that an episode is of: the page is loaded again with that robot.

const select = document.getElementById("robot");
select.addEventListener("change", () => {
  const address = new URL(window.location.href);
  if (select.value) address.searchParams.set("robot", select.value);
  else address.searchParams.delete("robot");
  window.location.assign(address);
});
