// What a served page does in the browser alone, without asking the server.
window.dash_clientside = Object.assign({}, window.dash_clientside, {
  inspector: {
    counts: function (step, iteration, depth) {
      return ["step " + step, "iteration " + iteration, "depth " + depth];
    },

    // Marks the frame that is nearest to the step.
    here: function (step, frames) {
      var nearest = Math.min.apply(null, frames.map(function (frame) { return Math.abs(frame.step - step); }));
      var first = frames.findIndex(function (frame) { return Math.abs(frame.step - step) === nearest; });
      return frames.map(function (frame, place) { return place === first ? "here" : ""; });
    },

    // The clicked candidate of either side: at most one, none of a new plan. What stays is not sent.
    clicked: function (one, two, clickA, clickB, unclick, nowA, nowB) {
      var triggered = dash_clientside.callback_context.triggered, stays = dash_clientside.no_update;
      var cause = triggered.length === 1 ? triggered[0].prop_id : "";
      var click = cause === "latent_plane-a.clickData" ? clickA : cause === "latent_plane-b.clickData" ? clickB : null;
      var found = click ? click.points[0].customdata : null;
      if (found === undefined) { return [stays, stays]; }
      var wanted = [click && click === clickA ? found : null, click && click === clickB ? found : null];
      return [nowA, nowB].map(function (now, side) {
        return wanted[side] === (now === undefined ? null : now) ? stays : wanted[side];
      });
    },

    // Of a second plan beside the first: what stands already; the other side is drawn in the new width.
    fit: function () { requestAnimationFrame(function () { fitFigures(".side-a"); }); },

    ring: function (candidate, plane) {
      moveRing(document.getElementById(plane).querySelector(".js-plotly-plot"), candidate);
    }
  }
});

// Dash's controls have no names of their own: those of their groups, for who hears the page.
new MutationObserver(function () {
  document.querySelectorAll("[role=group] [role=slider], [role=group] input:not([type=radio])").forEach(function (control) {
    if (!control.hasAttribute("aria-label")) {
      control.setAttribute("aria-label", control.closest("[role=group]").getAttribute("aria-label"));
    }
  });
}).observe(document.documentElement, { childList: true, subtree: true });
