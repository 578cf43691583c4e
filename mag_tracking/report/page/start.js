'use strict';
begin(JSON.parse(document.getElementById('data').textContent));
