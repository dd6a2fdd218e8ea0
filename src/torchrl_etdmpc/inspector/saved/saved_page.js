// A saved page: draws the figures in INSPECTION (data.js), and follows the scrubber and clicks. It asks for nothing.
(function () {
  "use strict";
  var state = { iteration: INSPECTION.iterations - 1, candidate: null, side: 0 };
  var config = { displayModeBar: false };

  function numbers(packed) { // base64 of little-endian float32
    var text = atob(packed), bytes = new Uint8Array(text.length);
    for (var i = 0; i < text.length; i += 1) { bytes[i] = text.charCodeAt(i); }
    return new Float32Array(bytes.buffer);
  }

  function figureOf(side, name) {
    var made = INSPECTION.sides[side].figures[name];
    return Array.isArray(made) ? made[Math.min(state.iteration, made.length - 1)] : made;
  }

  function copy(figure) { return JSON.parse(JSON.stringify(figure)); }

  function draw(side, name) {
    var div = document.getElementById(name + "-" + "ab"[side]);
    var clicked = state.candidate !== null && state.side === side, packed = INSPECTION.sides[side].returns;
    var filled = name === "return_table" && clicked && packed;
    var figure = copy(filled ? packed.table : figureOf(side, name));
    if (filled) { fill(figure, side); }
    Plotly.react(div, figure.data, figure.layout, config).then(function () {
      if (name === "latent_plane" && clicked) { moveRing(div, state.candidate); }
    });
  }

  // The return table of a candidate: rows of depths, columns of dynamics and value heads.
  function fill(figure, side) {
    var packed = INSPECTION.sides[side].returns;
    packed.numbers = packed.numbers || numbers(packed.data);
    var shape = packed.shape, columns = shape[3] * shape[4], rows = [];
    var iteration = Math.min(state.iteration, shape[0] - 1);
    var begin = (iteration * shape[1] + state.candidate) * shape[2] * columns;
    for (var row = 0; row < shape[2]; row += 1) {
      rows.push(Array.from(packed.numbers.subarray(begin + row * columns, begin + (row + 1) * columns)));
    }
    figure.data[0].z = rows;
    var score = INSPECTION.sides[side].scores[iteration][state.candidate];
    figure.layout.title = { text: "candidate " + state.candidate + ", score " + (score === null ? "not finite" : score.toFixed(3)), font: { size: 13 } };
  }

  function choose(side, candidate) {
    moveRing(document.getElementById("latent_plane-" + "ab"[side]), candidate);
    draw(side, "return_table");
  }

  function drawAll(names) {
    INSPECTION.sides.forEach(function (made, side) {
      (names || Object.keys(made.figures)).forEach(function (name) { draw(side, name); });
    });
    document.getElementById("iteration-value").textContent = (state.iteration + 1) + " of " + INSPECTION.iterations;
  }

  var scrubber = document.getElementById("iteration");
  scrubber.addEventListener("input", function () {
    state.iteration = Number(scrubber.value) - 1;
    drawAll(INSPECTION.moving);
  });
  drawAll();
  if (INSPECTION.difference) {
    Plotly.react("difference", INSPECTION.difference.data, INSPECTION.difference.layout, config);
  }
  INSPECTION.sides.forEach(function (made, side) {
    var div = document.getElementById("latent_plane-" + "ab"[side]);
    div.on("plotly_click", function (event) {
      var candidate = event.points[0].customdata;
      if (candidate === undefined) { return; }
      var before = state.side;
      state.candidate = candidate;
      state.side = side;
      if (before !== side) { choose(before, null); }
      choose(side, candidate);
    });
  });
})();
