(function () {
  const place = document.getElementById("view");
  const figure = JSON.parse(document.getElementById("view-data").textContent);
  const options = { responsive: true, displaylogo: false, scrollZoom: true,
    // Only buttons that work on the page itself.
    modeBarButtons: [["toImage", "zoom3d", "pan3d", "orbitRotation", "resetCameraDefault3d"]] };
  Plotly.newPlot(place, figure.data, figure.layout, options)
    .then(function () {
      // The place narrows where the page is laid out again, as by its fonts, without a resize.
      new ResizeObserver(function () {
        if (place.offsetParent) Plotly.Plots.resize(place);
      }).observe(place);
      // Browsers print an empty canvas: keep a picture for paper.
      return Plotly.toImage(place, { format: "png", width: 1000, height: 620 });
    })
    .then(function (picture) {
      document.getElementById("view-print").src = picture;
    })
    .catch(function (error) {
      place.textContent = "The 3D view needs WebGL: " + error.message;
    });
})();
