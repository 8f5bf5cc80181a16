// The interface to read and to try, out of openapi.json. Nothing is asked of another host: no validator's badge either.

/* global SwaggerUIBundle */
window.swagger = SwaggerUIBundle({
  url: "openapi.json",
  dom_id: "#swagger-ui",
  deepLinking: true,
  validatorUrl: null,
  presets: [SwaggerUIBundle.presets.apis],
});
