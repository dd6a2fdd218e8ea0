// What a served and a saved page have in common: the theme, the width of figures, the ring around a candidate.
(function () {
  "use strict";
  // The toggle overrides the system's choice and is kept by this browser.
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

  // Figures take the width that there is. Their height is their own: following that too, as plotly's and dash's own
  // ways do, every figure that is drawn resizes those beside it, and they each other. Within an element, or all.
  window.fitFigures = function (within) {
    document.querySelectorAll((within || "") + " .js-plotly-plot").forEach(function (graph) {
      var drawn = graph.querySelector(".main-svg"), width = graph.clientWidth;
      if (drawn && width && Math.abs(drawn.getAttribute("width") - width) > 1) {
        Plotly.relayout(graph, { width: width });
      }
    });
  };
  var pageWidth = null;
  new ResizeObserver(function (entries) {
    if (entries[0].contentRect.width === pageWidth) { return; }  // the page has grown longer, no figure wider
    pageWidth = entries[0].contentRect.width;
    requestAnimationFrame(function () { fitFigures(); });
  }).observe(document.documentElement);
  window.matchMedia("print").addEventListener("change", function () { fitFigures(); });  // at once: paper does not wait

  // A shape of the layout, which is moved without drawing a mark anew; none around no candidate.
  window.moveRing = function (graph, candidate) {
    var rings = [];
    if (!graph || !graph.data || !graph.layout.meta) { return; }
    graph.data.forEach(function (trace) {
      var place = candidate === null || !trace.customdata ? -1 : trace.customdata.indexOf(candidate);
      if (place >= 0) {
        rings.push(Object.assign({}, graph.layout.meta.ring, {
          xref: trace.xaxis, yref: trace.yaxis, xanchor: trace.x[place], yanchor: trace.y[place]
        }));
      }
    });
    if (rings.length || (graph.layout.shapes || []).length) {
      Plotly.update(graph, {}, { shapes: rings });  // of Plotly.relayout dash hears, and draws the whole figure again
    }
  };
})();
