// The theme: the toggle overrides the system's choice and is kept by this browser.
(function () {
  "use strict";
  function show(theme) {
    if (theme) { document.documentElement.setAttribute("data-theme", theme); }
  }
  try { show(localStorage.getItem("inspector-theme")); } catch (error) { /* no storage: nothing to keep */ }
  document.addEventListener("click", function (event) {
    var button = event.target.closest && event.target.closest("#theme");
    if (!button) { return; }
    var now = document.documentElement.getAttribute("data-theme")
      || (window.matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
    var next = now === "dark" ? "light" : "dark";
    show(next);
    try { localStorage.setItem("inspector-theme", next); } catch (error) { /* likewise */ }
  });
})();
